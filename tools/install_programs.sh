#!/usr/bin/env bash
# Install the programs that some tests run and the virtual environment does not hold: Chromium, which draws the HTML view,
# and the routing engines OSRM and Valhalla. Tests whose program is absent are skipped, so that a machine where this
# cannot be done passes, too.
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

# These wheels hold programs that any Python can start, but are made for 3.12 and later.
install_router() { # NAME PACKAGE PROGRAM
  [ -x ".programs/$1/$3" ] || .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
    --only-binary :all: --python-version 3.12 --upgrade --target ".programs/$1" "$2" \
    || echo "$2 could not be installed; the tests that need it are skipped" >&2
}
install_router osrm osrm-bindings osrm/bin/osrm-routed
install_router valhalla pyvalhalla valhalla/bin/valhalla_service
