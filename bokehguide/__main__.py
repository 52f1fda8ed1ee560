"""`python -m bokehguide` is the command `bokehguide`."""

import sys

from bokehguide.cli import main

sys.exit(main())
