"""One run: its parts, its loop, what it leaves behind; and sweeps of many."""
