"""`python -m hpamdp` is `hpamdp`."""

from hpamdp.cli import main

# Worker processes import this file again.
if __name__ == "__main__":
    main()
