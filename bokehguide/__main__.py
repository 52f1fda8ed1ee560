"""`python -m bokehguide` is the command `bokehguide`."""

import signal
import sys

signal.signal(signal.SIGINT, signal.SIG_DFL)  # until `main` has its own handlers

from bokehguide.cli import main  # noqa: E402

sys.exit(main())
