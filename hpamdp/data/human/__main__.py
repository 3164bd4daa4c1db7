"""`python -m hpamdp.data.human`: see `hpamdp.data.human.cli`."""

import sys

from hpamdp.data.human.cli import main

sys.exit(main())
