from __future__ import annotations

import gzip
from pathlib import Path

import pandas as pd
import pytest

from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">\n'
DRIVE = (
    HEAD
    + """<metadata><time>2020-01-01T00:00:00Z</time></metadata>
<wpt lat="1" lon="2"><ele>3</ele></wpt>
<trk><name>to work</name>
  <trkseg>
    <trkpt lat="41.8700" lon="-87.65"><ele>180.5</ele><time>2024-05-01T08:00:00Z</time></trkpt>
    <trkpt lat="41.8701" lon="-87.65"><ele>180.7</ele><time>2024-05-01T10:00:01.500+02:00</time>
      <extensions><gpxtpx:TrackPointExtension xmlns:gpxtpx="http://www.garmin.com/xmlschemas/TrackPointExtension/v2">
        <gpxtpx:speed>11.5</gpxtpx:speed><gpxtpx:course>359</gpxtpx:course>
      </gpxtpx:TrackPointExtension></extensions></trkpt>
  </trkseg>
  <trkseg></trkseg>
  <trkseg><trkpt lat="41.8710" lon="-87.65"><time>2024-05-01T08:05:00Z</time></trkpt></trkseg>
</trk>
<trk><trkseg><trkpt lat="41.8720" lon="-87.66"><time>2024-05-01T09:00:00Z</time></trkpt></trkseg></trk>
</gpx>"""
)
UNTIMED = HEAD + '<trk><trkseg><trkpt lat="41.87" lon="-87.65"/><trkpt lat="41.88" lon="-87.65"/></trkseg></trk></gpx>'


def test_every_segment_is_a_trace_with_all_it_carries(tmp_path: Path) -> None:
    (tmp_path / "monday.gpx").write_text(DRIVE)
    traces = read_fleet(tmp_path / "monday.gpx").traces
    assert traces["trace_id"].tolist() == ["monday/0/0", "monday/0/0", "monday/0/2", "monday/1/0"]
    assert traces["t"].dt.strftime("%H:%M:%S.%f").tolist()[:2] == ["08:00:00.000000", "08:00:01.500000"]
    assert traces["z"].tolist()[:2] == [180.5, 180.7]
    assert traces["z"].isna().tolist() == [False, False, True, True]
    assert traces["speed"].tolist()[1] == 11.5
    assert traces["heading"].tolist()[1] == pytest.approx(359.0, abs=0.5)  # from true north to that of the grid


def test_tracks_without_time_are_in_driving_order(tmp_path: Path) -> None:
    (tmp_path / "a.gpx").write_text(UNTIMED)
    traces = read_fleet(tmp_path).traces
    assert traces["t"].isna().all()
    assert traces["y"].is_monotonic_increasing


def test_folders_are_searched_and_names_do_not_collide(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.gpx").write_text(UNTIMED)
    (tmp_path / "2.gpx.gz").write_bytes(gzip.compress(UNTIMED.encode()))
    assert read_fleet(tmp_path).traces["trace_id"].unique().tolist() == ["2/0/0", "a/1/0/0", "b/1/0/0"]
    assert read_fleet([tmp_path / "a" / "1.gpx", tmp_path / "b" / "1.gpx"]).n_traces == 2


def test_prefixed_elements_and_gpx_1_0(tmp_path: Path) -> None:
    text = UNTIMED.replace("<trk", "<g:trk").replace("</trk", "</g:trk").replace("gpx version", "g:gpx version")
    (tmp_path / "a.gpx").write_text(text.replace("</gpx>", "</g:gpx>").replace("xmlns=", "xmlns:g="))
    assert len(read_fleet(tmp_path / "a.gpx").traces) == 2
    old = UNTIMED.replace('lat="41.88" lon="-87.65"/>', 'lat="41.88" lon="-87.65"><speed>3</speed></trkpt>')
    (tmp_path / "a.gpx").write_text(old)
    assert read_fleet(tmp_path / "a.gpx").traces["speed"].tolist()[1] == 3.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (DRIVE.replace("</trk>\n<trk>", "</trkk>\n<trk>"), "broken XML at line 15, column 3: mismatched tag"),
        (DRIVE[:600], "broken XML at line"),
        (HEAD + '<rte><rtept lat="1" lon="2"/></rte></gpx>', "no track points (routes and waypoints are not traces)"),
        ("<kml></kml>", "the root element is <kml>, not <gpx>"),
        (UNTIMED.replace("41.88", "north"), "column 'lat' (y) is not a number in 1 of 2 rows (track point 1: north)"),
        (UNTIMED.replace('lat="41.88"', ""), "column 'lat' (y) is empty or not finite in 1 of 2 rows"),
        (UNTIMED.replace("41.88", "95"), "latitudes are outside -90..90 in 1 of 2 rows (track point 1: 95.0)"),
        (DRIVE.replace("2024-05-01T08:05", "1 May, 8:05"), "column 'time' (t) is not a time in 1 of 4 rows"),
        (DRIVE.replace("<time>2024-05-01T08:00:00Z</time>", ""), "some fixes of 1 traces have no time (a/0/0)"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.gpx").write_text(text)
    with pytest.raises(InputError) as caught:
        read_fleet(tmp_path / "a.gpx")
    assert str(caught.value).startswith(str(tmp_path / "a.gpx"))
    assert message in str(caught.value)


def test_a_truncated_or_damaged_gzip_is_refused(tmp_path: Path) -> None:
    whole = gzip.compress(UNTIMED.encode())
    for content in (whole[:-12], whole[:30] + b"\xff" * 20 + whole[50:], UNTIMED.encode()):
        (tmp_path / "a.gpx.gz").write_bytes(content)
        with pytest.raises(InputError, match="broken gzip"):
            read_fleet(tmp_path)


def test_crs_other_than_wgs84_contradicts_gpx(tmp_path: Path) -> None:
    (tmp_path / "a.gpx").write_text(UNTIMED)
    with pytest.raises(InputError, match="which contradicts the CRS given"):
        read_fleet(tmp_path, crs="EPSG:32616")


def test_gpx_is_like_the_same_table(tmp_path: Path) -> None:
    (tmp_path / "a.gpx").write_text(UNTIMED)
    (tmp_path / "b.csv").write_text("lat,lon\n41.87,-87.65\n41.88,-87.65\n")
    gpx, text = read_fleet(tmp_path / "a.gpx"), read_fleet(tmp_path / "b.csv")
    pd.testing.assert_frame_equal(gpx.traces.drop(columns="trace_id"), text.traces.drop(columns="trace_id"))


POINTS = "".join(f'<trkpt lat="48.{number}" lon="11.{number}"/>' for number in (5, 1, 9, 3))
TIMED = "".join(
    f'<trkpt lat="48.1" lon="11.{number}"><time>2024-05-01T08:00:0{number}Z</time></trkpt>' for number in (1, 2)
)


def downloaded(folder: Path, *segments: str, creator: str = "OpenStreetMap.org") -> Path:
    head = f'<?xml version="1.0"?><gpx version="1.0" creator="{creator}" xmlns="http://www.topografix.com/GPX/1/0">'
    body = "".join(f"<trk><trkseg>{segment}</trkseg></trk>" for segment in segments)
    (folder / "points.gpx").write_text(f"{head}{body}</gpx>")
    return folder / "points.gpx"


def test_anonymous_points_are_no_drive(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(InputError, match="4 of 4 track points of the OpenStreetMap server are anonymous, no drive"):
        read_fleet(downloaded(tmp_path, POINTS))
    assert read_fleet(downloaded(tmp_path, POINTS, TIMED)).traces["trace_id"].unique().tolist() == ["points/1/0"]
    assert "4 of 6 track points of the OpenStreetMap server are anonymous, no drive: left out" in caplog.text
    with pytest.raises(InputError, match="are anonymous"):
        read_fleet(tmp_path / "points.gpx", invalid="refuse")


def test_other_points_without_time_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert len(read_fleet(downloaded(tmp_path, POINTS, creator="receiver")).traces) == 4
    assert "4 of 4 track points have no time and count as driven in their order" in caplog.text
