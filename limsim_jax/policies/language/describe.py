"""A scene as text, and the words for actions.

Each `Style` is a protocol: what is said in which order, which actions exist, and how an answer is written.
`PLAIN` is our own. `LIMSIM_PP`, `LIMSIM_PP_VISION` and `DILU` keep the sections, action names or numbers and
periods of LimSim++ (arXiv 2402.01246) and DiLu (arXiv 2309.16292), in words of our own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.host import FAR
from limsim_jax.policies.language.scene import NONE, TTC_LIMIT, Facts, Neighbour, time_to_collision
from limsim_jax.traffic.ego import Meta

MOST_TOKENS = 350
"""Tokens of a description, at most."""

Form = Literal["json", "hashes", "decision"]

MEANS = {
    Meta.KEEP: "hold the speed",
    Meta.ACCELERATE: "drive faster",
    Meta.DECELERATE: "brake gently",
    Meta.LEFT: "change to the lane on the left",
    Meta.RIGHT: "change to the lane on the right",
    Meta.STOP: "brake to a standstill",
}
"""Actions in words."""


@dataclass(frozen=True)
class Style:
    """A protocol between driver and model.

    Attributes:
      name: of the protocol.
      labels: the word or number of each action, as the model writes it.
      form: of an answer: a JSON object; free text that ends in `####` and a number; or free text with a
        section `## Decision`.
      period: s between questions.
      temperature: of the sampling.
      max_tokens: of an answer.
      timeout: s, of a whole call.
      images: whether pictures stand for the list of vehicles, and all is said in one message.
      example: whether a worked example comes before the scene.
    """

    name: str
    labels: Mapping[Meta, str] = field(hash=False)
    form: Form = "json"
    period: float = 1.0
    temperature: float = 0.0
    max_tokens: int = 160
    timeout: float = 20.0
    images: bool = False
    example: bool = False


PLAIN = Style("plain", {action: action.name for action in Meta})
LIMSIM_PP = Style(
    "limsim_pp",
    {Meta.ACCELERATE: "1", Meta.DECELERATE: "2", Meta.LEFT: "3", Meta.RIGHT: "4", Meta.KEEP: "8"},
    form="hashes",
    max_tokens=2000,
    timeout=60.0,
    example=True,
)
LIMSIM_PP_VISION = Style(
    "limsim_pp_vision",
    {
        Meta.ACCELERATE: "Acceleration",
        Meta.DECELERATE: "Deceleration",
        Meta.LEFT: "Turn-left",
        Meta.RIGHT: "Turn-right",
        Meta.KEEP: "IDLE",
    },
    form="decision",
    temperature=0.5,
    max_tokens=4000,
    timeout=60.0,
    images=True,
)
DILU = Style(
    "dilu",
    {Meta.LEFT: "0", Meta.KEEP: "1", Meta.RIGHT: "2", Meta.ACCELERATE: "3", Meta.DECELERATE: "4"},
    form="hashes",
    max_tokens=2000,
    timeout=60.0,
)
STYLES: dict[str, Style] = {style.name: style for style in (PLAIN, LIMSIM_PP, LIMSIM_PP_VISION, DILU)}
"""Protocols by name."""


def available(style: Style, told: Facts) -> dict[Meta, str]:
    """The labels of the actions that the ego can take now.

    Args:
      style: of the answers.
      told: facts of one ego, as numbers.
    """
    closed = {Meta.LEFT} if not told.left else set()
    closed |= {Meta.RIGHT} if not told.right else set()
    return {action: label for action, label in style.labels.items() if action not in closed}


def role(style: Style) -> str:
    """What the model is and how it answers; the same in every question of a run."""
    task = (
        "You drive a car in simulated right-hand traffic. Drive safely first, then along the route, then "
        "briskly up to the speed limit. Choose one action for the next second, out of those that are offered."
    )
    return f"{task} {_FORMS[style.form]}"


_FORMS: dict[Form, str] = {
    "json": 'Answer with a JSON object: {"reason": at most 80 characters, "action": one offered name}.',
    "hashes": "Think step by step. Write the number of your action on the last line, after ####.",
    "decision": (
        "Answer in three sections: ## Description, ## Reasoning and ## Decision. The line after ## Decision "
        "is one offered name, and nothing more."
    ),
}


def description(style: Style, told: Facts) -> str:
    """The scene of one ego as text, in a fixed order.

    Args:
      style: of the protocol.
      told: facts of one ego, as numbers.

    Returns:
      At most `MOST_TOKENS` tokens. Lengths and speeds have one decimal.
    """
    offered = available(style, told)
    if style.form == "json":
        return "\n".join([_own(told), *_around(told), _signal(told), _route(told), _plain_offer(offered)])
    actions = "\n".join(f"{_means(action)}: {label}" for action, label in offered.items())
    if style.images:
        navigation = f"{_own(told)} {_signal(told)}\n{_route(told)}"
        return f"## Available actions\n{actions}\n## Navigation information\n{navigation}"
    scene = "\n".join([_own(told), *_around(told), _signal(told)])
    text = f"Driving scenario description:\n{scene}\nDriving intentions:\n{_intention(told)}"
    text += f"\nAvailable actions:\n{actions}"
    return text if style.name == DILU.name else f"{text}\nNavigation hint:\n{_route(told)}"


def worked_example(style: Style) -> tuple[str, str]:
    """A scene and the right answer to it."""
    none = Neighbour(NONE, 0.0)
    told = Facts(
        v=14.0, limit=16.7, ahead=Neighbour(18.0, 8.0), left_ahead=none, left_behind=none, right_ahead=none,
        right_behind=none, light=int(SignalState.OFF), light_distance=FAR, to_go=0, to_go_within=0.0,
        left=False, right=False,
    )  # fmt: skip
    closing = told.v - told.ahead.v
    reason = (
        f"The vehicle ahead is {_number(told.ahead.gap)} m away and {_number(closing)} m/s slower, a TTC of "
        f"{_number(told.ahead.gap / closing)} s. There is no other lane. I brake gently."
    )
    return description(style, told), f"{reason}\n#### {style.labels[Meta.DECELERATE]}"


def token_bound(text: str) -> int:
    """Tokens of a text, estimated from above: each digit, mark and piece of four letters counts."""
    words = re.findall(r"[A-Za-z]+|[^A-Za-z\s]", text)
    return sum(-(-len(word) // 4) if word.isalpha() else 1 for word in words)


def _means(action: Meta) -> str:
    return MEANS[action]


def _own(told: Facts) -> str:
    return f"Ego: speed {_number(told.v)} m/s, limit {_number(told.limit)} m/s."


def _around(told: Facts) -> list[str]:
    return [
        _ahead("Ahead", told, told.ahead),
        _ahead("Left ahead", told, told.left_ahead),
        _behind("Left behind", told, told.left_behind),
        _ahead("Right ahead", told, told.right_ahead),
        _behind("Right behind", told, told.right_behind),
    ]


def _ahead(name: str, told: Facts, other: Neighbour) -> str:
    return _vehicle(name, other, told.v - other.v, told.v)


def _behind(name: str, told: Facts, other: Neighbour) -> str:
    return _vehicle(name, other, other.v - told.v, other.v)


def _vehicle(name: str, other: Neighbour, closing: float, follower: float) -> str:
    if other.gap >= NONE:
        return f"{name}: none."
    ttc = float(time_to_collision(other.gap, closing))
    text = f"{name}: gap {_number(other.gap)} m, speed {_number(other.v)} m/s"
    text += f", time gap {_number(other.gap / follower)} s" if follower > 1 else ""
    return text + (f", TTC {_number(ttc)} s." if ttc < TTC_LIMIT else ", not closing.")


def _signal(told: Facts) -> str:
    if told.light_distance >= FAR or told.light == SignalState.OFF:
        return "Signal: none."
    name = SignalState(int(told.light)).name.lower().replace("_", " ")
    return f"Signal: {name}, stop line in {_number(told.light_distance)} m."


def _route(told: Facts) -> str:
    lanes = int(told.to_go)
    if not lanes:
        return "Route: stay on this lane."
    side, count = "left" if lanes > 0 else "right", abs(lanes)
    within = max(float(told.to_go_within), 0.0)
    return f"Route: {count} lane{'s' if count > 1 else ''} to the {side} within {_number(within)} m."


def _intention(told: Facts) -> str:
    return "Drive safely and do not collide." if not int(told.to_go) else _route(told)


def _plain_offer(offered: Mapping[Meta, str]) -> str:
    return "Actions: " + "; ".join(f"{label} = {MEANS[action]}" for action, label in offered.items()) + "."


def _number(value: Any) -> str:
    return f"{float(value):.1f}"
