"""Rooms: options that suit a room each, on the way through several of them."""
