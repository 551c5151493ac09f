from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from probe2road.errors import InputError
from probe2road.io.describe import describe_file
from probe2road.io.fleet_reader import read_fleet

SECONDS = range(4)
PHONE = [
    {"latitudeE7": 481000000 + 1000 * second, "longitudeE7": 115000000, "timestamp": f"2024-05-01T08:00:0{second}Z"}
    for second in SECONDS
]
SERVICE = [
    {"deviceId": 7, "fixTime": f"2024-05-01T08:00:0{second}.000+00:00", "coords": {"latitude": 48.1, "longitude": 11.5}}
    for second in SECONDS
]


def written(folder: Path, content: Any, name: str = "fixes.json") -> Path:
    (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))
    return folder / name


@pytest.mark.parametrize("content", [PHONE, SERVICE, {"locations": PHONE}, {"data": {"page": 1, "items": SERVICE}}])
def test_a_list_of_objects_is_a_table_of_fixes(tmp_path: Path, content: Any) -> None:
    path = written(tmp_path, content)
    assert read_fleet(path).traces["t"].dt.second.tolist() == list(SECONDS)
    assert describe_file(path)["fixes"] == 4


def test_one_object_a_line(tmp_path: Path) -> None:
    path = written(tmp_path, "".join(f"{json.dumps(record)}\n" for record in SERVICE), "fixes.jsonl")
    assert read_fleet(path).traces["trace_id"].tolist() == [7] * 4


def test_a_feature_collection_is_a_layer(tmp_path: Path) -> None:
    features = [
        {
            "type": "Feature",
            "properties": {"trip": 1, "time": f"2024-05-01T08:00:0{second}Z"},
            "geometry": {"type": "Point", "coordinates": [11.5, 48.1]},
        }
        for second in SECONDS
    ]
    path = written(tmp_path, {"type": "FeatureCollection", "features": features})
    assert read_fleet(path).traces["t"].dt.second.tolist() == list(SECONDS)
    assert describe_file(path)["content"] == "fleet data"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"a": 1', "cannot be read as JSON"),
        ({"a": [1, 2]}, "the file holds no JSON records"),
        ([{"a": 1}], "no column for x, y"),
    ],
)
def test_other_json_is_refused(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_fleet(written(tmp_path, content))
