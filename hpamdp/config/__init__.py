"""What a user may set: read by `compose`, checked by `schema` and `components`, refused in the words of `errors`."""
