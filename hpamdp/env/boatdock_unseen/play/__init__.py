"""People in sessions: the page on which they dock boats that they do not know, and the check of what they played."""
