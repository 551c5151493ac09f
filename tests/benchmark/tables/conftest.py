from dataclasses import replace

import pytest

from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.sets.prepare import prepare_dataset


@pytest.fixture(scope="session")
def sets(tmp_path_factory):
    """A folder with one small data set in it."""
    folder = tmp_path_factory.mktemp("sets")
    small = replace(find_dataset("interchange-diamond-1"), drive_km=40.0)
    prepare_dataset(small, folder / small.name, data="")
    return folder
