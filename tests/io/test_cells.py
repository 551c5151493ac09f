"""Lines in a column of text: one row is a drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet

PORTO = '"TRIP_ID","CALL_TYPE","TAXI_ID","TIMESTAMP","MISSING_DATA","POLYLINE"\n'
LINE = [[-8.618643, 41.141412], [-8.618499, 41.141376], [-8.620326, 41.14251]]


def written(folder: Path, text: str) -> Path:
    (folder / "drives.csv").write_text(text)
    return folder / "drives.csv"


def porto(*lines: object) -> str:
    rows = (
        f'"137263685862000058{number}","C","20000589","137263685{number}","False","{json.dumps(line)}"\n'
        for number, line in enumerate(lines)
    )
    return PORTO + "".join(rows)


def test_the_taxis_of_porto(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    traces = read_fleet(written(tmp_path, porto(LINE, [], LINE[:2]))).traces
    assert traces["trace_id"].value_counts(sort=False).tolist() == [3, 2]
    assert traces["t"].diff().dt.total_seconds().tolist()[1:3] == [15.0, 15.0]
    assert traces["vehicle_id"].unique().tolist() == [20000589]
    assert "15 s apart" in caplog.text
    apart = read_fleet(tmp_path / "drives.csv", interval=5.0).traces["t"].diff().dt.total_seconds()
    assert apart.tolist()[1:3] == [5.0, 5.0]


def test_wkt_lines_with_their_times(tmp_path: Path) -> None:
    path = written(tmp_path, "id;geom;timestamp\n7;LINESTRING(11.5 48.1,11.501 48.1);1714550400,1714550405\n")
    traces = read_fleet(path, crs="EPSG:4326").traces
    assert traces["trace_id"].tolist() == [7, 7]
    assert traces["t"].dt.second.tolist() == [0, 5]
    times = '"[""2024-05-01T08:00:00Z"",""2024-05-01T08:00:07Z""]"'
    path = written(tmp_path, f'id,geom,times\n7,"LINESTRING Z (11.5 48.1 500, 11.501 48.1 501)",{times}\n')
    traces = read_fleet(path, crs="EPSG:4326", columns={"t": "times"}).traces
    assert traces["t"].dt.second.tolist() == [0, 7]
    assert traces["z"].tolist() == [500.0, 501.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('trip,geometry\n1,"LINESTRING (0 0, 1 1)"\n', "lines have no times"),
        ('trip,start_time,geometry\n1,2024-05-01T08:00:00Z,"LINESTRING (0 0, 1 1)"\n', "has one time for each line"),
        ("id;geom;timestamp\n1;LINESTRING(0 0,1 1);1,2,3\n", r"in 1 of 1 lines \(row 0: 3 times, 2 positions\)"),
        ('trip,time,POLYLINE\n1,0,"[[1,2],[3]]"\n', "holds no positions .* that can be read"),
        ('trip,time,POLYLINE\n1,0,"[[1,2],[3,x]]"\n', "holds no positions .* that can be read"),
    ],
)
def test_lines_that_are_no_drives(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_fleet(written(tmp_path, text), crs="EPSG:4326")


def test_lines_without_times_are_read_if_the_user_says_so(tmp_path: Path) -> None:
    path = written(tmp_path, 'trip,geometry\n1,"LINESTRING (11.5 48.1, 11.501 48.1)"\n')
    fleet = read_fleet(path, crs="EPSG:4326", columns={"t": ""})
    assert len(fleet.traces) == 2
    assert fleet.traces["t"].isna().all()


def test_points_in_json(tmp_path: Path) -> None:
    rows = '1,0,"[11.5, 48.1]"\n1,1,"[11.501, 48.1]"\n'
    assert len(read_fleet(written(tmp_path, f"trip,time,position\n{rows}")).traces) == 2
