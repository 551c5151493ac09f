"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# A check must not fail by chance on a change that is not at fault: continuous integration draws the same examples
# every time. At a desk they are drawn anew, which is how they find what nobody thought of.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("repeatable")
