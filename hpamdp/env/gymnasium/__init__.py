"""The way in for other people's Gymnasium environments."""
