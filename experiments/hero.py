"""The moving picture of the README: nine seeds of one experiment side by side, each with its verdict.

    python experiments/hero.py

writes docs/hero.gif. A pane stops at the first contact of the ego, and turns red.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

import limsim_jax as lj

OUT = Path(__file__).parent.parent / "docs" / "hero.gif"
BOUNDS = (-60.0, -34.4, 60.0, 34.4)  # m, around the middle of the roundabout
ACROSS, DOWN = 3, 3
WIDTH, HEIGHT, BAR = 288, 166, 22  # pixels of a pane, and of the line above it
BEGIN, END, STEP = 4.0, 22.0, 0.4  # s
MAP_ONLY = (0.01, 0.06, 0.92, 0.985)  # left, top, right and bottom of the map in a frame, shares
COLOURS = {"": (90, 96, 105), "arrived": (26, 127, 55), "contact": (207, 34, 46)}


def pane(world: lj.World) -> list[Image.Image]:
    """The frames of a world, with a line of text above each."""
    contact = next((x["time"] for x in world.moments if x["kind"] == "contact"), np.inf)
    blame = next((x["responsible"] for x in world.moments if x["kind"] == "contact"), "")
    inside = np.flatnonzero(world.trace.active[:, world.ego])
    arrival = world.trace.time[inside[-1]] if world.metrics["success"] else np.inf
    with tempfile.TemporaryDirectory() as folder:
        path = world.save(
            Path(folder) / "w.gif", bounds=BOUNDS, begin=BEGIN, end=END, every=round(STEP / 0.1), moments=()
        )
        with Image.open(path) as film:
            left, top, right, bottom = MAP_ONLY
            across, down = film.size
            part = left * across, top * down, right * across, bottom * down
            pictures = [frame.convert("RGB").crop(part) for frame in ImageSequence.Iterator(film)]
    font = ImageFont.load_default(12)
    frames = []
    for k in range(round((END - BEGIN) / STEP)):
        time = BEGIN + k * STEP
        state = "contact" if time >= contact else "arrived" if time >= arrival else ""
        stopped = min(time, contact)
        picture = pictures[min(round((stopped - BEGIN) / STEP), len(pictures) - 1)]
        frame = Image.new("RGB", (WIDTH, HEIGHT + BAR), COLOURS[state])
        frame.paste(picture.resize((WIDTH - 4, HEIGHT - 2), Image.Resampling.LANCZOS), (2, BAR))
        said = {"": f"{time:.1f} s", "arrived": "arrived", "contact": f"contact, {blame} at fault"}[state]
        ImageDraw.Draw(frame).text((6, 3), f"seed {world.seed}: {said}", fill="white", font=font)
        frames.append(frame)
    return frames


def main() -> None:
    """Run the worlds and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    drive = lj.Experiment("roundabout")
    policy = lj.ConstantSpeed()
    panes = [pane(drive.run(seed=seed, policy=policy)) for seed in range(ACROSS * DOWN)]
    pages = []
    for k in range(len(panes[0])):
        page = Image.new("RGB", (ACROSS * WIDTH, DOWN * (HEIGHT + BAR)), "white")
        for i, frames in enumerate(panes):
            page.paste(frames[k], (i % ACROSS * WIDTH, i // ACROSS * (HEIGHT + BAR)))
        pages.append(page.quantize(64, dither=Image.Dither.NONE))
    pages[0].save(arguments.out, save_all=True, append_images=pages[1:], duration=160, loop=0, optimize=True)
    print(f"wrote {arguments.out}, {arguments.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
