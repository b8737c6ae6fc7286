"""The table of the paper with all kinds of drivers: modular, end-to-end, and behind a chat server.

    python experiments/drivers.py

Times a decision of each driver, for one world on one core and in a batch of 64, and how long its program
compiles. Those behind a chat server are timed by their questions. How well they drive is taken from the
results of `policies.py`, `end_to_end.py` and `language.py`. Run it on an idle machine. Writes
experiments/results/drivers.json and .md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from policies import decisions
from readme_tables import drivers

from limsim_jax.files import write_whole

RESULTS = Path(__file__).parent / "results"
TIMED = ("pdm_closed", "limsim_tm", "end_to_end")


def main() -> None:
    """Time and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policies", nargs="+", default=list(TIMED), choices=TIMED)
    parser.add_argument("--scenario", default="roundabout")
    options = parser.parse_args()
    file = RESULTS / "drivers.json"
    found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"decisions": {}}
    for policy in options.policies:
        found["decisions"][policy] = {"scenario": options.scenario} | decisions(options.scenario, policy)
        print(policy, found["decisions"][policy], flush=True)
        write_whole(file, json.dumps(found, indent=1) + "\n")
    head = "Regenerate: `python experiments/drivers.py`\n\n"
    write_whole(RESULTS / "drivers.md", f"{head}{drivers(found)}\n")


if __name__ == "__main__":
    main()
