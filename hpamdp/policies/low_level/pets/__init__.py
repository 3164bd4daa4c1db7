"""PETS for parameterised actions: an ensemble of models, a policy that plans in them, and the learner of both."""
