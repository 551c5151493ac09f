"""Programs beside ours: run to their end, or serving on this machine until a context ends."""

from __future__ import annotations

import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from probe2road.errors import Probe2RoadError

__all__ = ["free_port", "run_program", "served"]

_HOST = "127.0.0.1"
_START = 30.0  # s that a server may take to answer


def free_port() -> int:
    """Return a free port on this machine."""
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])


def run_program(*command: str | Path, where: str) -> str:
    """Run a program until it ends, and return what it prints.

    Parameters
    ----------
    *command
        The program and its arguments.
    where
        What the program belongs to, for the message.

    Raises
    ------
    Probe2RoadError
        If it fails, with the last line it printed.

    Examples
    --------
    >>> import sys
    >>> run_program(sys.executable, "-c", "print(7)", where="Python").strip()
    '7'
    >>> run_program(sys.executable, "-c", "raise SystemExit('no roads')", where="Python")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    probe2road.errors.Probe2RoadError: Python: ... failed (no roads); check that the graph has edges
    """
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if done.returncode:
        fault = f"{Path(command[0]).name} failed ({_last_line(done.stdout + done.stderr)})"
        raise Probe2RoadError(fault, where=where, fix="check that the graph has edges")
    return done.stdout


@contextmanager
def served(*command: str | Path, port: int, where: str) -> Iterator[None]:
    """Run a server until the context ends, which begins when the server accepts connections.

    Parameters
    ----------
    *command
        The program and its arguments, from which it knows its port.
    port
        Where it listens on this machine.
    where
        What the program belongs to, for the message.

    Raises
    ------
    Probe2RoadError
        If it ends before, or accepts none within half a minute, with the last line it printed.

    Examples
    --------
    >>> import sys
    >>> port = free_port()
    >>> with served(sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1", port=port, where="Python"):
    ...     with socket.create_connection(("127.0.0.1", port)) as connection:
    ...         print(connection.getpeername()[1] == port)
    True
    """
    with tempfile.TemporaryFile() as log:
        server = subprocess.Popen([str(part) for part in command], stdout=log, stderr=subprocess.STDOUT)
        try:
            if not _accepts(server, port):
                raise Probe2RoadError(f"{Path(command[0]).name} did not start ({_written(log)})", where=where)
            yield
        finally:
            server.terminate()
            server.wait()


def _accepts(server: subprocess.Popen[bytes], port: int) -> bool:
    """Wait until a server accepts connections; False if it ended, or takes too long."""
    deadline = time.monotonic() + _START
    while time.monotonic() < deadline and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((_HOST, port)) == 0:
                return True
        time.sleep(0.05)
    return False


def _written(log: IO[bytes]) -> str:
    """Return the last line of a log."""
    log.seek(0)
    return _last_line(log.read().decode(errors="replace"))


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1]
