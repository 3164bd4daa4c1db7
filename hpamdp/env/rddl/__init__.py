"""Planning problems in RDDL, simulated by pyRDDLGym."""
