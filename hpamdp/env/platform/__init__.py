"""The Platform domain."""
