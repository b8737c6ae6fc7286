"""The camera network behind the chat endpoint: pictures get through, and mistakes are told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.bridges.chat.camera import Camera, _asked
from limsim_jax.bridges.chat.server import ChatServer
from limsim_jax.cli.main import main
from limsim_jax.policies.end_to_end.inputs import EGO
from limsim_jax.policies.end_to_end.network import (
    CAMERA,
    CHANGES,
    WHOLE,
    Network,
    Outputs,
    Trained,
    blank_inputs,
    fresh_weights,
    load_weights,
    save_weights,
)
from limsim_jax.policies.language.chat import message
from limsim_jax.policies.language.describe import LIMSIM_PP_VISION, PLAIN, available, description, role
from limsim_jax.policies.language.pictures import png, rig_of
from limsim_jax.policies.language.scene import NONE, Facts, Neighbour
from limsim_jax.traffic.ego import Meta

NOBODY = Neighbour(NONE, 0.0)


def facts(v=8.0, to_go=0, left=True, right=False):
    return Facts(
        v, 13.9, NOBODY, NOBODY, NOBODY, NOBODY, NOBODY, light=0, light_distance=1e4, to_go=to_go,
        to_go_within=60.0, left=left, right=right,
    )  # fmt: skip


def pictures(seed, size=(36, 64)):
    return np.random.default_rng(seed).integers(0, 256, (3, *size, 3)).astype(np.uint8)


def question(told, seen, style=LIMSIM_PP_VISION):
    images = [png(picture) for picture in seen]
    return {"model": "camera", "messages": [message("user", description(style, told), images, before=("x",))]}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """One network that always speeds up, one that brakes hard, one untrained, and one with LiDAR."""
    folder = tmp_path_factory.mktemp("weights")
    for name, wanted in (("fast", 2.0), ("brakes", -4.0), ("fresh", None)):
        layers = jax.device_get(fresh_weights(CAMERA, seed=3))
        if wanted is not None:
            layers["speed"]["kernel"] = np.zeros_like(layers["speed"]["kernel"])
            layers["speed"]["bias"] = np.where(np.array(CHANGES) == wanted, 30.0, 0.0).astype(np.float32)
        save_weights(folder / f"{name}.npz", Trained(CAMERA, layers, {}))
    save_weights(folder / "whole.npz", Trained(WHOLE, jax.device_get(fresh_weights()), {}))
    return folder


def test_pictures_arrive_as_they_were_taken():
    seen = pictures(1)
    text, got = _asked(question(facts(), seen))
    assert (got == seen).all()
    assert "Ego: speed 8.0 m/s" in text and "x" in text


def test_it_says_what_the_network_says_of_the_pictures(weights):
    model = Camera(weights / "fresh.npz")
    layers = load_weights(str(weights / "fresh.npz")).weights
    own = dict.fromkeys(EGO, 0.0) | {"speed": 8.0 / 20, "speed limit": 13.9 / 20, "speed is told": 1.0}
    ego = jnp.array([[own[name] for name in EGO]])
    texts = set()
    for seed in (1, 2, 3):
        inputs = blank_inputs()._replace(cameras=jnp.asarray(pictures(seed))[None], ego=ego)
        said = Network(CAMERA).apply({"params": layers}, inputs)
        assert isinstance(said, Outputs)
        change = float(np.asarray(jax.nn.softmax(said.speed))[0] @ np.array(CHANGES))
        answer = model(question(facts(), pictures(seed)))
        assert f"{change:+.1f} m/s" in answer
        texts.add(float(model._change(np.asarray(inputs.cameras[0]), np.asarray(ego[0]))))
    assert len(texts) == 3, "other pictures, other answers"


def test_actions_are_offered_ones(weights):
    fast, brakes = Camera(weights / "fast.npz"), Camera(weights / "brakes.npz")
    for style in (LIMSIM_PP_VISION, PLAIN):
        for told in (facts(), facts(to_go=1), facts(to_go=-1), facts(to_go=1, left=False)):
            labels = available(style, told)
            asked = question(told, pictures(1), style)
            lane = Meta.LEFT if told.to_go > 0 and told.left else Meta.ACCELERATE
            assert f'"{labels[lane]}"' in fast(asked)
            stops = Meta.STOP if Meta.STOP in labels else Meta.DECELERATE
            assert f'"{labels[stops]}"' in brakes(asked), "no lane change while it brakes"


def test_mistakes_are_told(weights, capsys):
    with pytest.raises(ValueError, match=r"whole.npz: this network needs more than pictures"):
        Camera(weights / "whole.npz")
    with ChatServer({"camera": Camera(weights / "fast.npz")}) as server:
        for seen, text in (
            (pictures(1)[:1], "pictures of 64 x 36; expected 3 of 64 x 36"),
            (pictures(1, (126, 224)), "224 x 126, 224 x 126; expected 3 of 64 x 36"),
        ):
            found = server.answer  # in the thread of the server errors become status 500
            with pytest.raises(ValueError, match=text):
                found(question(facts(), seen))
        plain = {"model": "camera", "messages": [message("system", role(PLAIN)), message("user", "hello")]}
        with pytest.raises(ValueError, match="no picture"):
            server.answer(plain)
    for change, text in (
        (["--model", "camera"], "goes with --model camera"),
        (["--model", "rules", "--weights", str(weights / "fast.npz")], "goes with --model camera"),
        (["--model", "camera", "--weights", "missing.npz"], "missing.npz: no weights"),
    ):
        assert main(["serve", "chat", *change]) in (1, 2)
        error = capsys.readouterr().err
        assert text in " ".join(error.split()), error


def test_its_rig_is_that_of_the_network():
    rig = rig_of("driver")
    assert [(c.width, c.height) for c in rig.cameras] == [(64, 36)] * 3
