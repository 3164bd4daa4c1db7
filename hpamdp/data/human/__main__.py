"""`python -m hpamdp.data.human`."""

import sys

from hpamdp.data.human.cli import main

sys.exit(main())
