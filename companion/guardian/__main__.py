"""Entry point of `python -m companion.guardian`, which the launcher starts."""

from __future__ import annotations

import sys

from companion.guardian.process import main

if __name__ == "__main__":
    sys.exit(main())
