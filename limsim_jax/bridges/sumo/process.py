"""A simulation of SUMO in a process of its own.

    with SumoProcess(Start(arguments=("-c", "x.sumocfg"), seed=3, dt=0.1)) as sumo:
        reading = sumo.step(Orders())

The child ends with its parent: it reads the end of its input.
"""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import limsim_jax
from limsim_jax.bridges.sumo.messages import Orders, Reading, Start, Started, SumoError

_LENGTH = struct.Struct("<Q")  # bytes of the message that follows

_UP = 64  # folders, more than any file lies deep

PATIENCE = 5.0
"""s in which a child may end by itself before it is killed."""


class SumoProcess:
    """A simulation that runs beside this process.

    Args:
      start: how it starts.

    Raises:
      SumoError: SUMO does not start, refuses an order, or its process ends; one line.
    """

    def __init__(self, start: Start) -> None:
        self.start = start
        self.time = 0.0
        self._said = tempfile.TemporaryFile()
        self._scratch = None if start.outputs else tempfile.TemporaryDirectory(prefix="limsim-sumo-")
        if self._scratch is not None:
            # a prefix stands behind the folder of each file; beyond the root there is no way up
            prefix = "../" * _UP + self._scratch.name.lstrip("/") + "/"
            more = ("--output-prefix", prefix, "--log", f"{self._scratch.name}/log.txt")
            start = replace(start, arguments=(*start.arguments, *more))
        package = str(Path(limsim_jax.__file__).parents[1])
        path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
        self.child = subprocess.Popen(
            [sys.executable, "-m", "limsim_jax.bridges.sumo.process"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said,
            env=os.environ | {"PYTHONPATH": path},
        )  # fmt: skip
        try:
            self._send(start)
            self.there: Started = self._receive()
        except BaseException:
            self.close()
            raise
        self.time = self.there.time

    def step(self, orders: Orders) -> Reading:
        """Do what is ordered, one step of the simulation, and read it."""
        self.ask(orders)
        return self.answer()

    def ask(self, orders: Orders) -> None:
        """The first half of `step`: several processes can work at the same time."""
        self._send(orders)

    def answer(self) -> Reading:
        """The second half of `step`."""
        reading: Reading = self._receive()
        self.time = reading.time
        return reading

    def close(self) -> None:
        """End the process; does nothing where it has ended."""
        for pipe in (self.child.stdin, self.child.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    pass
        try:
            self.child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
        self._said.close()
        if self._scratch is not None:
            self._scratch.cleanup()

    def __enter__(self) -> SumoProcess:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _send(self, message: Any) -> None:
        assert self.child.stdin is not None
        try:
            _write(self.child.stdin, message)
        except OSError:
            raise self._ended() from None

    def _receive(self) -> Any:
        assert self.child.stdout is not None
        try:
            found = _read(self.child.stdout)
        except (EOFError, OSError):
            raise self._ended() from None
        if isinstance(found, SumoError):
            said = _fault(self._words())
            raise SumoError(f"{found}: {said}" if said and said not in str(found) else str(found))
        return found

    def _ended(self) -> SumoError:
        """Why the process is no more."""
        try:
            code = self.child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            code = None
        said = _fault(self._words())
        why = f"exit code {code}" if code is None or code >= 0 else f"signal {-code}"
        place = f"seed {self.start.seed}, {self.time:.1f} s"
        return SumoError(f"the process of SUMO has ended ({place}, {why}){': ' + said if said else ''}")

    def _words(self) -> str:
        self._said.seek(0)
        return self._said.read().decode(errors="replace")


def _fault(text: str) -> str:
    """The first error in what SUMO has written."""
    lines = [line.strip() for line in text.splitlines()]
    found = [x.removeprefix("Error:").strip() for x in lines if x.startswith("Error")]
    return found[0] if found else ""


def _write(pipe: BinaryIO | Any, message: Any) -> None:
    data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    pipe.write(_LENGTH.pack(len(data)) + data)
    pipe.flush()


def _read(pipe: BinaryIO | Any) -> Any:
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    (size,) = _LENGTH.unpack(head)
    data = pipe.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)


def _serve() -> None:
    """The child: a simulation that follows orders until there are no more."""
    source, target = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what SUMO prints is no message
    from limsim_jax.bridges.sumo.link import Link

    link = None
    try:
        while True:
            try:
                message = _read(source)
            except EOFError:
                return
            try:
                if isinstance(message, Start):
                    link = Link(message)
                    answer: Any = link.started()
                else:
                    assert link is not None
                    answer = link.step(message)
            except SumoError as error:
                answer = error
            except Exception as error:
                answer = SumoError(f"SUMO: {' '.join(str(error).split()) or type(error).__name__}")
            _write(target, answer)
    except (BrokenPipeError, KeyboardInterrupt):
        pass
    finally:
        if link is not None:
            link.close()


if __name__ == "__main__":
    _serve()
