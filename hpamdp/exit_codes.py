"""Exit codes of the command line."""

FAILED = 1
MISTAKE = 2  # of the user: a refused setting, file or environment
DIVERGED = 3
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
