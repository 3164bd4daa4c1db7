"""The Gymnasium id of Office."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

OFFICE_ID = "hpamdp/Office-v0"


def register() -> None:
    """Register the id with Gymnasium; calling it again changes nothing."""
    register_batched_env(OFFICE_ID, "hpamdp.env.office.environment:OfficeEnv")
