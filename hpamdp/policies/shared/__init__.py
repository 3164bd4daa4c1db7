"""Parts that several learners or selectors share."""
