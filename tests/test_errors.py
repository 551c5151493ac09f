import subprocess
import sys

import pytest

from probe2road.errors import MissingExtraError, needs_extra


def test_a_missing_package_names_the_extra_to_install():
    message = r"this feature needs .* pip install 'probe2road\[train\]'"
    with pytest.raises(MissingExtraError, match=message) as caught, needs_extra("train", feature="this feature"):
        import no_such_package  # noqa: F401
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)
    assert isinstance(caught.value, ImportError)


def test_a_broken_package_keeps_its_own_error():
    with pytest.raises(ImportError, match="libtorch") as caught, needs_extra("train", feature="this feature"):
        raise ImportError("libtorch.so: cannot open shared object file")
    assert not isinstance(caught.value, MissingExtraError)


@pytest.mark.parametrize("module", ["segmentation.losses"])
def test_a_module_of_an_extra_says_what_to_install(module):
    code = f"import sys; sys.modules['torch'] = None; import probe2road.{module}"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'probe2road[train]'" in run.stderr.splitlines()[-1]
