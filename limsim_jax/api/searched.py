"""What searches for failures have in common: failures that run again, and a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from limsim_jax.api.world import World
    from limsim_jax.sweeps.episode import Episodes


class Searched:
    """Failures that were found; it can replay them, and a notebook shows its table."""

    if TYPE_CHECKING:
        scenario: str
        policy: str
        failures: Any
        episodes: Episodes

        def rows(self) -> list[tuple[str, str]]:
            """The table in two columns."""
            ...

    def replay(self, number: int = 0, *, explain: bool = True) -> World:
        """Run a failure again and keep every step; `number` is that of `failures`."""
        from limsim_jax.api.world import World

        if not 0 <= number < len(self.failures):
            raise ValueError(f"failure {number}: there are {len(self.failures)}, from 0")
        return World.run(self.episodes, number, explain=explain)

    def _repr_html_(self) -> str:
        import html

        rows = "".join(f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td></tr>" for a, b in self.rows())
        return f"<b>{html.escape(self.scenario)}, {html.escape(self.policy)}</b><table>{rows}</table>"
