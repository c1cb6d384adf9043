"""``python -m tools.cli``: the same as ``dualcal``."""

from tools.cli import main

main()
