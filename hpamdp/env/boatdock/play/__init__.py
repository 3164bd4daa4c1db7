"""People at the task: the page on which they play, and the checks and the file of their episodes."""
