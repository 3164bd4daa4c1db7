"""Settings that selectors share which learn values of options off-policy."""

from __future__ import annotations
