"""Programs beside ours end with their context, and say why they do not start."""

from __future__ import annotations

import socket
import sys

import pytest

from probe2road.errors import Probe2RoadError
from probe2road.matching.servers import free_port, run_program, served


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_a_server_listens_in_its_context_only():
    port = free_port()
    command = [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1"]
    with served(*command, port=port, where="Python"):
        assert listens(port)
    assert not listens(port)


def test_a_server_that_ends_says_why():
    refused = served(sys.executable, "-c", "raise SystemExit('first\\nno tiles')", port=free_port(), where="roads")
    with pytest.raises(Probe2RoadError, match=r"^roads: .*python.* did not start \(no tiles\)"), refused:
        pytest.fail("there is no server")


def test_a_program_that_fails_says_why():
    assert run_program(sys.executable, "-c", "print('well')", where="roads") == "well\n"
    with pytest.raises(Probe2RoadError, match=r"^roads: .*python.* failed \(no message\)"):
        run_program(sys.executable, "-c", "raise SystemExit(3)", where="roads")
