"""People at the task: the page on which they play it, and the check and the file of what they did."""
