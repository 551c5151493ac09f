from __future__ import annotations

from pathlib import Path

import pytest

from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet

GEOLIFE = "Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0,2,255,My Track,0,0,2,8421376\n0\n"
OZI = GEOLIFE.replace("Geolife trajectory", "OziExplorer Track Point File Version 2.1")


def lines(*, feet: float = 492.0, date: str = "2008-10-23", cut: int = -1) -> str:
    return "".join(
        f"39.90{second},116.40,{int(second == cut)},{feet},{39744.25 + second / 86400:.10f},{date},06:00:{second:02d}\n"
        for second in range(4)
    )


def test_geolife(tmp_path: Path) -> None:
    folder = tmp_path / "Data" / "000" / "Trajectory"
    folder.mkdir(parents=True)
    (folder / "20081023060000.plt").write_text(GEOLIFE + lines())
    traces = read_fleet(tmp_path / "Data").traces
    assert traces["trace_id"].unique().tolist() == ["000/Trajectory/20081023060000"]
    assert [str(time) for time in traces["t"]] == [f"2008-10-23 06:00:0{second}+00:00" for second in range(4)]
    assert traces["z"].tolist() == pytest.approx([149.9616] * 4)


def test_oziexplorer_counts_days_marks_interruptions_and_knows_no_height(tmp_path: Path) -> None:
    (tmp_path / "walk.plt").write_text(OZI + lines(feet=-777.0, date="Thu", cut=2))
    traces = read_fleet(tmp_path / "walk.plt").traces
    assert traces["trace_id"].tolist() == ["walk/0", "walk/0", "walk/1", "walk/1"]
    assert str(traces["t"].iloc[1]) == "2008-10-23 06:00:01+00:00"
    assert traces["z"].isna().all()


def test_damaged_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "walk.plt"
    path.write_text(GEOLIFE)
    with pytest.raises(InputError, match=r"walk\.plt"):
        read_fleet(path)
    path.write_text(GEOLIFE + "39.9,116.4\n" + lines())
    with pytest.raises(InputError, match="1 lines do not have 7 fields"):
        read_fleet(path)
    assert len(read_fleet(path, invalid="drop").traces) == 4
    assert "1 lines do not have 7 fields: left out" in caplog.text
    path.write_text(GEOLIFE + lines().replace("116.40", "x"))
    with pytest.raises(InputError, match="is not a number"):
        read_fleet(path)
