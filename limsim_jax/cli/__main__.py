"""`python -m limsim_jax.cli`."""

import sys

from limsim_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
