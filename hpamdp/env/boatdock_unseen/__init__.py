"""Sessions of trips with boats that the agent does not know."""
