"""A small network that answers by the pictures of a question.

It proves that pictures, text and actions get through to a driver that is conditioned on images. It is no
language model.
"""

from __future__ import annotations

import base64
import io
import pickle
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.bridges.chat.replies import decision
from limsim_jax.policies.end_to_end.inputs import EGO, FAR, LANES, SPEED
from limsim_jax.policies.end_to_end.network import (
    TARGET_TIME,
    Network,
    Outputs,
    blank_inputs,
    load_weights,
    target_speed,
)
from limsim_jax.policies.language.reading import read_description
from limsim_jax.policies.language.scene import Facts
from limsim_jax.traffic.ego import META_ACCELERATION, Meta

PICTURES, HEIGHT, WIDTH = 3, 36, 64
"""Pictures of a question, and their pixels: those of `cameras="driver"`."""

WAIT = -1.0
"""m/s within `TARGET_TIME`: an ego that is to slow down by more does not change lanes."""


class Camera:
    """A model that reads pictures, speed, limit and lanes to cross.

        with lj.ChatServer({"camera": Camera("camera.npz")}) as server:
            lj.sweep("highway", policies=lj.language(server.url, "camera", style="limsim_pp_vision",
                                                     cameras="driver"))

    Args:
      weights: file of `limsim-jax train end-to-end --design camera`.

    Raises:
      ValueError: no such file, or the network needs more than a question tells.
    """

    takes_images = True

    def __init__(self, weights: str | Path) -> None:
        trained = load_weights(str(weights))
        if trained.design.lidar or trained.design.route:
            raise ValueError(
                f"{weights}: this network needs more than pictures; "
                "`limsim-jax train end-to-end --design camera` makes one that does not"
            )

        self._weights, self._process, self._lock = str(weights), None, threading.Lock()

    def __call__(self, request: dict[str, Any]) -> str:
        """The answer to a question.

        Raises:
          ValueError: other pictures than expected, or no description.
        """
        text, pictures = _asked(request)
        told, offered = read_description(text)
        change = self._change(pictures, _own(told))
        action = _action(change, told, offered)
        return decision(offered[action], f"the pictures ask for {change:+.1f} m/s")

    def _change(self, pictures: NDArray[np.uint8], own: NDArray[np.float32]) -> float:
        """The change of speed that the network asks for, m/s.

        It runs in a process of its own: worlds that wait for an answer hold all threads of theirs.
        """
        with self._lock:
            if self._process is None:
                command = [sys.executable, "-m", __name__, self._weights]
                self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
                weakref.finalize(self, _end, self._process)
            assert self._process.stdin is not None and self._process.stdout is not None
            pickle.dump((np.asarray(pictures), np.asarray(own)), self._process.stdin)
            self._process.stdin.flush()
            return pickle.load(self._process.stdout)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.communicate()


def _answer_questions(weights: str) -> None:
    """Answer questions on standard input, pictures and numbers, with changes of speed."""
    trained, out = load_weights(weights), sys.stdout.buffer
    sys.stdout = sys.stderr

    @jax.jit
    def change(cameras: Any, ego: Any) -> Any:
        inputs = blank_inputs()._replace(cameras=cameras[None], ego=ego[None])
        said = Network(trained.design).apply({"params": trained.weights}, inputs)
        assert isinstance(said, Outputs)
        v = ego[None, EGO.index("speed")] * SPEED
        return (target_speed(v, said.speed) - v)[0]

    while True:
        try:
            pictures, own = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(float(change(jnp.asarray(pictures), jnp.asarray(own))), out)
        out.flush()


def _action(change: float, told: Facts, offered: dict[Meta, str]) -> Meta:
    """The offered action for a change of speed (m/s): lanes of the route first, if nothing is in the way."""
    side = Meta.LEFT if told.to_go > 0 else Meta.RIGHT
    if told.to_go and side in offered and change > WAIT:
        return side
    speeds = [x for x in offered if x not in (Meta.LEFT, Meta.RIGHT)]
    return min(speeds, key=lambda x: abs(META_ACCELERATION[x] * TARGET_TIME - change))


def _own(told: Facts) -> NDArray[np.float32]:
    """What the text tells of the ego, as the network has it; the rest is 0."""
    row = dict.fromkeys(EGO, 0.0)
    row["speed"], row["speed limit"] = told.v / SPEED, told.limit / SPEED
    row["lanes to cross"] = float(np.clip(told.to_go, -4, 4)) / LANES
    row["distance within which to cross them"] = float(np.clip(told.to_go_within / FAR, 0, 1))
    row["speed is told"] = 1.0
    return np.array([row[name] for name in EGO], np.float32)


def _asked(request: dict[str, Any]) -> tuple[str, NDArray[np.uint8]]:
    """The texts of the last message with pictures, joined, and its pictures."""
    from PIL import Image

    for message in reversed(request["messages"]):
        parts = message["content"]
        if isinstance(parts, list) and any(x["type"] == "image_url" for x in parts):
            break
    else:
        raise ValueError("no picture; expected 3, as cameras='driver' sends them")
    pictures = []
    for part in parts:
        if part["type"] == "image_url":
            data = part["image_url"]["url"].partition("base64,")[2]
            with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
                pictures.append(np.asarray(picture.convert("RGB"), np.uint8))
    shapes = [x.shape for x in pictures]
    if shapes != [(HEIGHT, WIDTH, 3)] * PICTURES:
        sizes = ", ".join(f"{wide} x {high}" for high, wide, _ in shapes)
        raise ValueError(
            f"pictures of {sizes}; expected {PICTURES} of {WIDTH} x {HEIGHT}, as cameras='driver' sends them"
        )
    return "\n".join(x["text"] for x in parts if x["type"] == "text"), np.stack(pictures)


if __name__ == "__main__":
    _answer_questions(sys.argv[1])
