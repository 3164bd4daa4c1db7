"""Train or score a two-level agent; `python run.py --help` tells what can be set."""

from hpamdp.cli import main

# Worker processes import this file again.
if __name__ == "__main__":
    main()
