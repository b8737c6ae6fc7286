"""A progress bar for sweeps; without a terminal, lines."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

from limsim_jax.sweeps.runner import Progress


@contextlib.contextmanager
def _bar(figures: str) -> Iterator[tuple[Any, bool]]:
    """A bar with these figures behind it, and whether it is shown: in a terminal or a notebook."""
    from rich import progress as rich_progress
    from rich.console import Console

    console = Console()
    live = console.is_terminal or console.is_jupyter
    with rich_progress.Progress(
        rich_progress.TextColumn("{task.description:<28}"),
        rich_progress.BarColumn(bar_width=24),
        rich_progress.TextColumn(figures),
        console=console,
        disable=not live,
    ) as bar:
        yield bar, live


@contextlib.contextmanager
def progress_bar(shown: bool = True) -> Iterator[Callable[[Progress], None] | None]:
    """What `runner.sweep` tells its progress to.

    In a terminal or a notebook it is a bar. Elsewhere (logs, batch jobs) it prints a line when a scenario
    starts to compile, when it starts to run, and when it is finished.
    """
    if not shown:
        yield None
        return
    with _bar("{task.completed:.0f}/{task.total:.0f} worlds  {task.fields[said]}") as (bar, live):
        tasks: dict[tuple[str, str], Any] = {}
        stages: dict[tuple[str, str], str] = {}

        def show(now: Progress) -> None:
            key = now.scenario, now.policy
            name = f"{now.scenario} / {now.policy}"
            if key not in tasks:
                tasks[key] = bar.add_task(name, total=now.wanted, said="")
            said = f"{now.km:,.0f} km  {now.contacts:.0f} contacts"
            if now.stage == "compiling":
                said = "compiling"
            elif not math.isnan(now.eta) and now.stage == "running":
                said += f"  {now.eta:.0f} s left"
            bar.update(tasks[key], completed=now.done, said=said)
            before, stages[key] = stages.get(key), now.stage
            if live or before == now.stage:
                return
            if now.stage == "finished":
                print(f"{name}: {now.done} of {now.wanted} worlds, {said}, {now.elapsed:.0f} s", flush=True)
            elif now.stage == "compiling":
                print(f"{name}: compiling, which takes up to a minute the first time", flush=True)

        yield show


@contextlib.contextmanager
def count_bar(shown: bool, name: str) -> Iterator[Callable[[int, int], None] | None]:
    """A bar of worlds that have run, of the most that may; without a terminal, a line every fifth of them."""
    if not shown:
        yield None
        return
    with _bar("{task.completed:.0f} of at most {task.total:.0f} worlds") as (bar, live):
        task, told = bar.add_task(name, total=1), -1

        def show(done: int, most: int) -> None:
            nonlocal told
            bar.update(task, completed=done, total=most)
            if not live and 5 * done // most > told:
                told = 5 * done // most
                print(f"{name}: {done} of at most {most} worlds", flush=True)

        yield show
