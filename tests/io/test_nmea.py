from __future__ import annotations

import gzip
from functools import reduce
from operator import xor
from pathlib import Path

import pytest

from probe2road.crs import WGS84, transform
from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode()):02X}"


def rmc(second: int, *, date: str = "010524", clock: str = "0800", status: str = "A") -> str:
    return sentence(f"GPRMC,{clock}{second:02d}.00,{status},4806.{second:04d},N,01130.0000,W,10.0,0.0,{date},,,A")


def gga(second: int, *, clock: str = "0800") -> str:
    return sentence(f"GNGGA,{clock}{second:02d}.00,4806.{second:04d},N,01130.0000,W,1,08,0.9,520.5,M,46.9,M,,")


def log(folder: Path, *lines: str, name: str = "drive.nmea") -> Path:
    (folder / name).write_text("\r\n".join(lines) + "\r\n")
    return folder / name


@pytest.mark.parametrize("name", ["drive.nmea", "drive.log", "drive.txt", "drive.csv"])
def test_sentences_of_one_time_are_one_fix(tmp_path: Path, name: str) -> None:
    lines = [line for second in range(4) for line in (rmc(second), gga(second))]
    fleet = read_fleet(log(tmp_path, *lines, name=name))
    traces = fleet.traces
    assert traces["trace_id"].tolist() == ["drive"] * 4
    assert [str(time) for time in traces["t"]] == [f"2024-05-01 08:00:0{second}+00:00" for second in range(4)]
    assert traces["speed"].tolist() == pytest.approx([5.144444] * 4)
    assert traces["z"].tolist() == [520.5] * 4
    lon, lat = transform(traces["x"].to_numpy(), traces["y"].to_numpy(), fleet.crs, WGS84)
    assert (round(float(lon[0]), 6), round(float(lat[3]), 6)) == (-11.5, 48.100005)


def test_packed_logs_with_something_before_the_sentences(tmp_path: Path) -> None:
    path = tmp_path / "drive.nmea.gz"
    with gzip.open(path, "wt") as file:
        file.write("# started\n" + "".join(f"12:00:0{second} RX {rmc(second)}\n" for second in range(3)))
    assert len(read_fleet(path).traces) == 3


def test_wrong_checksums_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lines = [rmc(second) for second in range(4)]
    lines[2] = lines[2].replace("4806", "4807")
    assert len(read_fleet(log(tmp_path, *lines)).traces) == 3
    assert "1 of 4 NMEA sentences have a wrong checksum: left out" in caplog.text
    with pytest.raises(InputError, match="1 of 4 NMEA sentences have a wrong checksum"):
        read_fleet(tmp_path / "drive.nmea", invalid="refuse")
    with pytest.raises(InputError, match="3 of 4 NMEA sentences have a wrong checksum"):
        read_fleet(log(tmp_path, lines[0], *[line.replace("4806", "4807") for line in lines[1:2]], lines[2], lines[2]))


def test_void_fixes_are_none(tmp_path: Path) -> None:
    assert len(read_fleet(log(tmp_path, rmc(0, status="V"), rmc(1), rmc(2))).traces) == 2
    with pytest.raises(InputError, match="no NMEA sentence RMC or GGA holds a position"):
        read_fleet(log(tmp_path, sentence("GPRMC,080000,V,,,,,,,010524,,,N"), sentence("GPGSV,1,1,00")))


def test_midnight_and_logs_without_date(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    late = [rmc(59, date="310524", clock="2359"), gga(0, clock="0000"), rmc(1, date="010624", clock="0000")]
    assert read_fleet(log(tmp_path, *late)).traces["t"].diff().dt.total_seconds().tolist()[1:] == [1.0, 1.0]
    fleet = read_fleet(log(tmp_path, gga(59, clock="2359"), gga(0, clock="0000")))
    assert fleet.traces["t"].diff().dt.total_seconds().tolist()[1:] == [1.0]
    assert "no sentence holds a date" in caplog.text


def test_logs_hold_no_semantic_points(tmp_path: Path) -> None:
    path = log(tmp_path, rmc(0), rmc(1))
    with pytest.raises(InputError, match="NMEA holds no semantic points"):
        read_fleet(path, path)
