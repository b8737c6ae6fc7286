"""Phrases of instructions, and what each changes; tried in this order."""

from __future__ import annotations

import re
from collections.abc import Callable
from re import Match
from typing import Any

from limsim_jax.scenarios.instructions.draft import BRISK, EGO, SCENE, Draft, span
from limsim_jax.scenarios.instructions.intent import ActKind, InstructionError

HARD, EMERGENCY, GENTLE = 6.0, 8.0, 2.0
"""m/s^2 of "hard", "emergency" and "gentle" braking; without a word, `place.STEADY`."""

WET, SNOW, ICE = 0.5, 0.3, 0.1
"""Friction, as documented at `[[zone]]`."""

Effect = Callable[[Draft, Match[str]], None]


# ---- parts of phrases


def verbs(*words: str) -> str:
    """The forms of verbs: "brake", "brakes", "braking"."""
    forms = []
    for word in words:
        doubled = word + word[-1] if word in ("cut", "stop", "run") else word.removesuffix("e")
        ending = "es" if word.endswith(("ss", "sh", "ch", "x", "o")) else "s"
        forms += [f"{word}{ending}", f"{doubled}ing", word]
    return f"(?:{'|'.join(forms)})"


def number(name: str, unit: str) -> str:
    """A number or a range with a unit: "20 m", "between 20 and 30 m"."""
    n = r"\d+(?:\.\d+)?"
    return (
        r"(?:about |around |roughly |some |only |just )?(?:between )?"
        rf"(?P<{name}>{n})(?: ?(?:to|-|and) ?(?P<{name}2>{n}))? ?(?P<{name}u>{unit})(?![/\w])"
    )


SPEED = number("v", "m/s|mps|km/h|kmh|kph|mph")
METRES = number("d", "m|metres?|meters?")
SECONDS = number("t", "s|secs?|seconds?")
BRAKING = number("b", r"m/s2|m/s\^2|m/s²|g")
OWN = r"(?:the |our )?ego(?:'s)?(?: vehicle| car)?|us|me|our (?:car|vehicle)|the vehicle under test|the av"
OURS = rf"(?:{OWN}|the ego's|our|my)"
OWN = f"(?:{OWN})"
HOW = r"(?:hard|sharply|heavily|strongly|suddenly|abruptly|gently|slightly|softly|fully|firmly)"
NOUNS = {
    "truck": r"(?:articulated )?(?:trucks?|lorry|lorries)|semis?|(?:semi-)?trailers?|tankers?|hgvs?|"
    r"heavy goods vehicles?",
    "van": r"(?:delivery |transit |camper )?vans?|minibus(?:es)?",
    "bus": r"(?:city |school |double-decker )?bus(?:es)?|coach(?:es)?",
    "motorcycle": r"motor(?:cycle|bike)s?|motorcyclists?",
    "emergency": r"ambulances?|police (?:cars?|vehicles?|vans?)|fire (?:engines?|trucks?)|"
    r"emergency vehicles?",
    "obstacle": r"obstacles?|debris|box(?:es)?|barriers?|cones?|pallets?|objects?|tyres?|tires?|rocks?|"
    r"boulders?|trees?|branch(?:es)?|lost cargo",
    "car": r"(?:passenger |estate |sports )?cars?|vehicles?|sedans?|saloons?|hatchbacks?|minivans?|"
    r"pickups?(?: trucks?)?|jeeps?|limousines?|cabs?|taxis?|suvs?|motorists?|drivers?",
}
NOUN = f"(?:{'|'.join(NOUNS[kind] for kind in ('emergency', *NOUNS))})"
ADJECTIVES: dict[str, dict[str, Any]] = {
    r"slow|slower|slow[- ]moving": {"acts": ({"kind": "slow"},)},
    r"fast|faster|speeding|fast[- ]moving": {"faster": (BRISK, BRISK)},
    r"stationary|parked|stopped|standing|broken[- ]down": {"acts": ({"kind": "stand"},)},
    r"oncoming": {"place": "oncoming"},
    r"crossing": {"acts": ({"kind": "cross"},)},
    r"merging": {"acts": ({"kind": "merge"},)},
    r"braking": {"acts": ({"kind": "brake"},)},
    r"overtaking": {"acts": ({"kind": "overtake"},)},
    r"tailgating": {"acts": ({"kind": "tailgate"},), "place": "behind"},
    r"aggressive|reckless": {"careless": True},
}
ADJECTIVE = f"(?:{'|'.join(ADJECTIVES)})"


# ---- what phrases do


def act(kind: ActKind) -> Effect:
    """The vehicle does this, on the side that the phrase names."""

    def put(draft: Draft, found: Match[str]) -> None:
        sides = [side for name, side in found.groupdict().items() if name.startswith("side") and side]
        draft.do(kind, **({"side": sides[0]} if sides else {}))

    return put


def scene(**what: Any) -> Effect:
    """The scene is so; numbers that follow are about it, where a road is named."""

    def put(draft: Draft, found: Match[str]) -> None:
        draft.scene |= {k: x for k, x in what.items() if k != "road" or draft.scene.get(k) != "ramp"}
        if "road" in what:
            draft.subject = SCENE

    return put


def refused(why: str) -> Effect:
    """What cannot be built."""

    def put(draft: Draft, found: Match[str]) -> None:
        raise InstructionError(f"'{found[0].strip()}': {why}")

    return put


def nothing(draft: Draft, found: Match[str]) -> None:
    """Words without a meaning of their own."""


def no_effect(draft: Draft, found: Match[str]) -> None:
    """What drivers here do not mind."""
    draft.notes.append(f"'{found[0].strip()}' has no effect: drivers see as by day")


def vehicle(draft: Draft, found: Match[str]) -> None:
    """A vehicle with its article and adjectives."""
    for adjective in re.findall(ADJECTIVE, found["adjs"] or ""):
        draft.waiting |= next(x for words, x in ADJECTIVES.items() if re.fullmatch(words, adjective))
    kind = next(kind for kind, words in NOUNS.items() if re.fullmatch(words, found["noun"]))
    article = (found["article"] or "").strip()
    draft.meet(kind, new=article not in ("the", "this", "that", ""))
    if article.isdigit():
        draft.actor()["count"] = int(article)
    if kind == "obstacle" and not draft.acts:
        draft.do("stand")


def leader(draft: Draft, found: Match[str]) -> None:
    """The vehicle ahead of the ego."""
    ahead = [k for k, actor in enumerate(draft.actors) if actor.get("place") == "ahead"]
    if ahead and not draft.waiting:
        draft.subject = ahead[-1]
    else:
        draft.waiting |= {"place": "ahead", "lane": "same"}
        draft.meet("car", new=True)


def pronoun(draft: Draft, found: Match[str]) -> None:
    """The last vehicle."""
    if draft.subject < 0 and draft.actors:
        draft.subject = len(draft.actors) - 1


def ego(draft: Draft, found: Match[str]) -> None:
    """The ego is spoken of."""
    draft.subject = EGO


def ahead(draft: Draft, found: Match[str]) -> None:
    """Before the ego: where the vehicle is, unless it gets there by what it does."""
    if draft.actors and draft.last not in ("cut_in", "merge", "cross", "turn_across"):
        draft.actor().setdefault("place", "ahead")


def behind(draft: Draft, found: Match[str]) -> None:
    """Of the ego: the next vehicle is ahead of it."""
    if draft.subject == EGO:
        draft.waiting["place"] = "ahead"


def speed(draft: Draft, found: Match[str]) -> None:
    """m/s of the ego, of a vehicle, or after its act."""
    v = span(found, "v")
    if draft.subject < 0:
        draft.scene["speed"] = v
    elif found["to"] and draft.last in ("accelerate", "brake"):
        draft.act()["speed"] = sum(v) / 2
    else:
        draft.actor()["speed"] = v


def faster(draft: Draft, found: Match[str]) -> None:
    """m/s more than the ego."""
    low, high = span(found, "v")
    draft.actor()["faster"] = (-high, -low) if found["which"] == "slower" else (low, high)


def distance(draft: Draft, found: Match[str]) -> None:
    """m to the ego: at the start, or, after a word about when, as the act begins."""
    m = span(found, "d")
    moving = "cut_in", "merge", "cross", "turn_across"
    if found["when"] and draft.last == "drive":
        raise InstructionError(f"'{found[0].strip()}': does not say what begins then")
    if found["when"] or draft.last in moving:
        draft.act()["gap"] = m
        return
    draft.actor()["gap"] = m
    if found["where"]:
        draft.actor().setdefault("place", "behind" if "behind" in found["where"] else "ahead")


def headway(draft: Draft, found: Match[str]) -> None:
    """s behind the other one, at the speed of the ego."""
    v = sum(draft.scene.get("speed", (25.0, 25.0))) / 2
    gap = tuple(t * v for t in span(found, "t"))
    (draft.act() if draft.last in ("cut_in", "merge") else draft.actor())["gap"] = gap


def brake(draft: Draft, found: Match[str]) -> None:
    """How hard, and down to what."""
    draft.do("brake")
    for words, rate in ((r"hard|sharp|heav|strong|sudden|abrupt|firm", HARD),
                        (r"emergency|full|slam", EMERGENCY), (r"gentl|slight|soft", GENTLE)):  # fmt: skip
        if re.search(words, found[0]):
            draft.act()["rate"] = rate
    if re.search(r"to an? (?:\w+ )?(?:stop|halt|standstill)", found[0]):
        draft.act()["speed"] = 0.0


def lane(draft: Draft, found: Match[str]) -> None:
    """The lane of a vehicle, or the side of its lane change."""
    side = found["side"]
    if draft.subject == EGO:
        raise InstructionError(f"'{found[0].strip()}': the ego's lane follows from where the others are")
    if side in ("left", "right"):
        if draft.last in ("cut_in", "cut_out", "change_lane") or (found["from"] and draft.last == "merge"):
            draft.act()["side"] = side
        else:
            draft.actor()["lane"] = side
    elif draft.last != "cut_in" and side not in ("next", "adjacent", "neighbouring", "other"):
        draft.actor()["lane"] = "same"


def from_side(draft: Draft, found: Match[str]) -> None:
    """Where a vehicle comes from; without another word, it crosses."""
    if draft.last == "drive":
        draft.do("cross")
    draft.act()["side"] = found["side"]


def turn(draft: Draft, found: Match[str]) -> None:
    """The ego at a junction, or an oncoming vehicle across its way."""
    if draft.subject < 0:
        draft.scene |= {"turn": found["side"]}
        draft.scene.setdefault("road", "crossing")
    elif found["side"] == "left":
        draft.do("turn_across")
        draft.actor().setdefault("place", "oncoming")
    else:
        raise InstructionError(f"'{found[0].strip()}': other vehicles turn left across the ego's way only")


def straight(draft: Draft, found: Match[str]) -> None:
    """The ego goes straight on at a junction."""
    if draft.subject < 0:
        draft.scene["turn"] = "straight"


def merge(draft: Draft, found: Match[str]) -> None:
    """From the ramp."""
    if draft.subject == EGO:
        draft.scene["merges"] = True
    else:
        draft.do("merge")
    draft.scene["road"] = "ramp"


def tailgate(draft: Draft, found: Match[str]) -> None:
    """Close behind the ego."""
    draft.do("tailgate")
    draft.actor().setdefault("place", "behind")


def follow(draft: Draft, found: Match[str]) -> None:
    """Behind the ego; close, where the phrase says so."""
    draft.do("tailgate" if found["close"] else "drive")
    draft.actor().setdefault("place", "behind")


def red_light(draft: Draft, found: Match[str]) -> None:
    """Over the stop line on red."""
    draft.do("run_red")
    draft.scene |= {"road": "crossing", "lights": True}


def field_of(name: str, value: Any) -> Effect:
    """A field of the vehicle."""
    return lambda draft, _: draft.actor().update({name: value})


def of_act(name: str, value: Callable[[Match[str]], Any]) -> Effect:
    """A field of the last act."""
    return lambda draft, found: draft.act().update({name: value(found)})


# ---- the phrases

_REFUSED: tuple[tuple[str, Effect], ...] = (
    (r"(?:a |the |an )?(?:pedestrians?|child(?:ren)?|people|person|cyclists?|bicycles?|bikes?|animals?|deer|"
     r"tram|train|scooters?)", refused("there are motor vehicles only")),
    (r"(?:in |on )?(?:a |the )?(?:bend|curve|hill|tunnel|bridge|parking lot|roadworks)",
     refused("places are lanes and junctions, not this")),
    (r"(?:in )?(?:thick |dense )?fog|at night|in the dark|foggy|dark", no_effect),
)  # fmt: skip

_VEHICLES: tuple[tuple[str, Effect], ...] = (
    (rf"(?:the )?(?:leader|lead(?:ing)? {NOUN}|preceding {NOUN}|{NOUN} (?:ahead|in front)(?: of {OWN})?)"
     r"(?= (?!and\b)\w*(?:s|es)\b| brak| suddenly| slow| stop)", leader),
    (r"(?P<article>another |a second |a third |a |an |the |this |that |\d )?"
     rf"(?P<adjs>(?:{ADJECTIVE} )*)(?P<noun>{NOUN})\b", vehicle),
    (rf"(?:that |which |who )?(?:is )?(?:ahead of|in front of|before|past|across) (?:{OWN}|it|them)"
     r"(?:'s path| path| way)?", ahead),
    (r"behind(?= (?:an?|the(?! ego)|another|\d) )", behind),
    (rf"(?:from behind|behind) ?{OWN}?", field_of("place", "behind")),
    (rf"from the opposite direction|(?:coming )?towards? (?:{OWN}|it|them)", field_of("place", "oncoming")),
    (rf"(?:beside|next to|alongside|level with) {OWN}", field_of("place", "beside")),
    (rf"(?:to|on|at) the (?P<side>left|right)(?: of {OWN})?(?! lane)(?P<from>)?", lane),
)  # fmt: skip

_LANE_CHANGES: tuple[tuple[str, Effect], ...] = (
    (rf"(?:{verbs('cut')} ?in|{verbs('pull')} (?:in|out)(?= in front| ahead| before)|"
     rf"{verbs('swerve', 'move', 'change', 'merge', 'pull')} (?:over )?(?:in)?to {OURS} lane|"
     rf"{verbs('cut')} (?:us|the ego)(?: off)?|{verbs('cut')} off (?:us|the ego))", act("cut_in")),
    (rf"(?:{verbs('cut')} ?out|{verbs('pull')} out(?: of (?:the|its|{OURS}) (?:lane|way))?|"
     rf"{verbs('swerve')} (?:out|away)|{verbs('leave')} (?:the|its|{OURS}) lane)", act("cut_out")),
    (rf"(?:{verbs('change')}(?: lanes?)? to the (?P<side>left|right)(?: lane)?|"
     rf"{verbs('move')} (?:over )?to the (?P<side2>left|right)(?: lane)?|{verbs('change')} lanes?)",
     act("change_lane")),
    (rf"(?:{verbs('overtake', 'pass')}) ?{OWN}?", act("overtake")),
    (rf"{verbs('merge', 'join')}(?: (?:from|onto|on|into|with|via) (?:the |an? )?(?:on-?ramp|ramp|slip road|"
     r"acceleration lane|motorway|highway|freeway|traffic|left|right))*", merge),
)  # fmt: skip

_SPEEDS: tuple[tuple[str, Effect], ...] = (
    (rf"(?:{HOW} )?(?:brak(?:es?|ing) in an emergency|{verbs('brake', 'decelerate')}|slows(?: down)?|"
     rf"slow(?:ing)? down|{verbs('slam', 'hit', 'stamp')} (?:on )?the brakes?|"
     r"(?:does|performs|makes) an? (?:emergency|full) (?:stop|brake|braking)|emergency[- ]brakes)"
     rf"(?:,? (?:very )?{HOW})*"
     r"(?: (?:down )?to an? (?:full |complete )?(?:stop|standstill|halt))?", brake),
    (r"(?:down )?to an? (?:full |complete )?(?:stop|standstill|halt)", of_act("speed", lambda _: 0.0)),
    (rf"(?:{verbs('stop')}|comes? to an? (?:stop|halt|standstill))", act("stop")),
    (rf"(?:{verbs('accelerate')}|{verbs('speed')} up)", act("accelerate")),
    (rf"{verbs('drive', 'go', 'move', 'travel')} (?:very )?slowly|{verbs('crawl')}|is (?:very )?slow",
     act("slow")),
    (r"(?:(?:is|has|that|which) )*(?:standing|stopped|parked|stationary|broken down)(?: still)?|"
     rf"stands?(?: still)?|{verbs('block')} (?:the|{OURS}) (?:lane|way|road)|lies", act("stand")),
    (rf"{verbs('tailgate')} ?{OWN}?|is close behind ?{OWN}?", tailgate),
    (rf"{verbs('follow')} (?P<close>(?:too |very )?closely ?){OWN}?", follow),
    (rf"{verbs('follow')} {OWN}(?P<close> (?:too |very )?closely)?", follow),
)  # fmt: skip

_JUNCTIONS: tuple[tuple[str, Effect], ...] = (
    (rf"(?:{verbs('run')} (?:a|the) red (?:light|signal)|{verbs('jump')} the (?:red )?lights?|"
     rf"{verbs('ignore')} (?:a|the|its) red light)", red_light),
    (rf"(?:does not|doesn't|without|fails to) (?:yield(?:ing)?|giv(?:e|ing) way)|"
     rf"{verbs('ignore')} (?:the |our )?(?:priority|right of way|stop sign)|"
     rf"{verbs('take')} (?:the|our) right of way", field_of("careless", True)),
    (rf"{verbs('cross')}(?: (?:the|{OURS}) (?:path|way|road|intersection|junction|crossing))?", act("cross")),
    (rf"(?:{verbs('come')} )?from the (?P<side>left|right)(?! lane)(?: side)?", from_side),
    (rf"{verbs('turn')} (?P<side>left|right)", turn),
    (rf"(?:{verbs('drive', 'go', 'cross')} )?straight (?:on|ahead|across|over)", straight),
)  # fmt: skip

_NUMBERS: tuple[tuple[str, Effect], ...] = (
    (rf"(?:leaving |with |at |in )?(?:an? )?(?:time gap|headway|gap) of {SECONDS}", headway),
    (rf"(?:with |leaving |at )?(?:an? )?(?:gap|distance) of (?P<when>)(?P<where>)?{METRES}"
     r"(?: ahead| behind)?", distance),
    (rf"(?P<when>when (?:it is |{OWN} is |it comes |{OWN} comes )?(?:within )?|within |"
     rf"once (?:it|{OWN}) is )?(?:leaving )?{METRES}"
     r"(?P<where> ?(?:ahead of|in front of|behind|away from|from|before|ahead|in front|away))?"
     rf" ?(?:{OWN}|it|them)?", distance),
    (rf"(?:with |by |at )?{SPEED} (?P<which>faster|slower)(?: than {OWN})?", faster),
    (rf"(?:with |and )?(?:a |the )?(?:speed )?limit (?:of |is )?{SPEED}",
     lambda draft, found: draft.scene.update(limit=sum(span(found, "v")) / 2)),
    (rf"(?:at |with |doing |(?P<to>(?:down )?to )|of )?(?:a speed of )?{SPEED}", speed),
    (rf"(?:with|by|at) (?:a deceleration of )?{BRAKING}", of_act("rate", lambda m: sum(span(m, "b")) / 2)),
    (rf"(?:after |at )?{SECONDS}(?: later| after the start)?", of_act("at", lambda m: sum(span(m, "t")) / 2)),
    (r"(?:in|on|into|(?P<from>from)) (?:the )?"
     r"(?P<side>left|right|same|next|adjacent|neighbouring|other|our|its|my)(?:-hand)? lane", lane),
    (rf"(?:in|on) (?:{OWN}|the ego's|our) lane", field_of("lane", "same")),
)  # fmt: skip

_SCENE: tuple[tuple[str, Effect], ...] = (
    (rf"(?:while |when |as |and )?{OWN}|we", ego),
    (r"(?P<n>\d)[- ]lane(?:s|d)?|with (?P<n2>\d) lanes",
     lambda draft, found: draft.scene.update(lanes=int(found["n"] or found["n2"]))),
    (r"motorway|highway|freeway|autobahn|expressway|interstate|carriageway", scene(road="motorway")),
    (r"(?:rural|country)(?: road)?", scene(road="rural")),
    (r"(?:town|city|urban|inner-city)(?: (?:road|street))?|street", scene(road="town")),
    (r"unsignali[sz]ed (?:crossroads|crossing|intersection|junction)", scene(road="crossing", lights=False)),
    (r"signali[sz]ed (?:crossroads|crossing|intersection|junction)", scene(road="crossing", lights=True)),
    (r"crossroads|crossing|intersection|junction", scene(road="crossing")),
    (r"with traffic lights|at (?:a |the )?traffic lights?|at (?:the )?lights", scene(lights=True)),
    (r"uncontrolled|without (?:traffic )?lights", scene(lights=False)),
    (rf"(?:{verbs('enter')} )?(?:a |the )?(?:roundabout|traffic circle)", scene(road="roundabout")),
    (r"(?:from |on |onto |at )?(?:an? |the )?(?:on-?ramp|ramp|slip road|acceleration lane)",
     scene(road="ramp")),
    (r"wet|rainy|slippery|(?:in |with )?(?:the |heavy |light |pouring )?rain(?:fall|ing|s)?|drizzle",
     scene(friction=WET)),
    (r"(?:in |on )?(?:snowy|snow-covered|snow(?:fall|ing|s)?(?: covers)?)", scene(friction=SNOW)),
    (r"(?:on )?(?:icy|black ice|ice(?: covers)?)", scene(friction=ICE)),
    (r"(?:in |with )?(?:busy|dense|heavy|rush[- ]hour)(?: traffic)?", scene(traffic="dense")),
    (r"(?:in |with )?(?:moderate|normal|medium)(?: traffic)?", scene(traffic="moderate")),
    (r"(?:in |with )?(?:light|sparse|little|quiet)(?: traffic)?", scene(traffic="light")),
    (r"(?:with |and )?(?:no (?:other )?traffic|empty|deserted)", scene(traffic="none")),
)  # fmt: skip

_FILLERS: tuple[tuple[str, Effect], ...] = (
    (r"(?:it|he|she|they|who|which|that)", pronoun),
    (rf"{verbs('drive', 'travel', 'move', 'go', 'approach', 'wait', 'come', 'cruise', 'enter', 'reveal')}"
     rf"(?: {OWN})?(?: along| up)?|doing", nothing),
    (r"(?:an?|the|and|then|but|with|on|at|in|of|to|for|so|there|is|are|was|has|while|when|as|after|suddenly|"
     r"abruptly|roads?|lanes?|straight|dry|scenario|where|its|our|by|from|very|also|just|sharply|closely|both|"
     r"ahead|in front|way|path|onto|into|over|immediately|unexpectedly|traffic|again|during|please|simulate|"
     r"show|create|test|appears?|shows up|becomes visible|comes into (?:view|sight)|across)", nothing),
)  # fmt: skip

PHRASES = tuple(
    (re.compile(rf"(?:{words})(?!\w)"), effect)
    for group in (_REFUSED, _VEHICLES, _LANE_CHANGES, _SPEEDS, _JUNCTIONS, _NUMBERS, _SCENE, _FILLERS)
    for words, effect in group
)
