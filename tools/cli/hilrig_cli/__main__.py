"""`python -m hilrig_cli`: the same as `hilrig`."""

import sys

from hilrig_cli.main import main

sys.exit(main())
