from dataclasses import replace

import pytest

from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.sets.prepare import prepare_dataset

DATASET = "interchange-diamond-1"


@pytest.fixture(scope="session")
def sets(tmp_path_factory):
    """A folder of prepared data sets: the diamond interchange with 60 km of drives."""
    folder = tmp_path_factory.mktemp("sets")
    prepare_dataset(replace(find_dataset(DATASET), drive_km=60.0), folder / DATASET, data="")
    return folder
