#!/usr/bin/env bash
# Install the programs that some tests run and the virtual environment does not hold: Chromium, which draws the HTML view,
# and OSRM. Tests whose program is absent are skipped, so that a machine where this cannot be done passes, too.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

has_chromium() { command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null

if ! has_chromium; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    export DEBIAN_FRONTEND=noninteractive
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; } >/dev/null \
      || echo 'Chromium could not be installed; the tests that need it are skipped' >&2
  else
    echo 'Chromium is absent, and only root can install it with apt-get; the tests that need it are skipped' >&2
  fi
fi

# The wheel holds programs that any Python can start, but is made for 3.12 and later.
if [ ! -x .programs/osrm/osrm/bin/osrm-routed ]; then
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --only-binary :all: --python-version 3.12 \
    --upgrade --target .programs/osrm osrm-bindings \
    || echo 'OSRM could not be installed; the tests that need it are skipped' >&2
fi
