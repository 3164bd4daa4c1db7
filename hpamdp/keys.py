"""Names of the entries of a tensordict."""

OBSERVATION = "observation"
OPTION = "option"
ACTION = "action"
DISCRETE = (ACTION, "discrete")
PARAMETERS = (ACTION, "parameters")
REWARD = "reward"
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
OUTCOME = "outcome"  # how the episode ended, in an environment's own codes

# Written by an environment whose episodes are sessions of trips (`ProblemCard.has_trips`): the step ended a trip.
TRIP_ENDED = "trip_ended"

# Written by an environment that forbids some choices: the allowed choices in its current state.
ACTION_MASK = "action_mask"  # discrete actions
PAIR_MASK = "pair_mask"  # discrete actions of a later component, given one of an earlier component
OPTION_MASK = "option_mask"  # options

# Written by an environment whose steps take different times: how long this step took, in the unit of the discount.
DURATION = "duration"

# Written by an environment whose parameters have other bounds in each state.
PARAMETER_LOW, PARAMETER_HIGH = "parameter_low", "parameter_high"

# Written by DecisionTracker.
IS_DECISION = "is_decision"
OPTION_RETURN, OPTION_STEPS = "option_return", "option_steps"
DECISION_OBSERVATION = "decision_observation"
OPTION_ENDED = "option_ended"  # only where options may end inside their episodes
EPISODE_RETURN, EPISODE_STEPS = "episode_return", "episode_steps"

# Written by the agent with agent.termination=chosen: after how many steps the option ends.
OPTION_LENGTH = "option_length"

# Written by the selector with agent.termination=learned: under `held`, the choice that was held before this step.
HELD = "held"

# Written by the agent for its learners if there is `option_ended`: the option that holds in the next state.
NEXT_OPTION = ("next", "option")

# Written by the policy with exploration=held: whether exploration took the action of this step, and what it holds after
# the step: for how many more steps, which discrete action, with which parameters in [-1, 1].
IS_HELD = "is_held"
HOLD_STEPS, HOLD_DISCRETE, HOLD_UNIT = "hold_steps", "hold_discrete", "hold_unit"

# Written by an environment that knows the best action; read by the `oracle` selector and the `planner` learner.
ORACLE_OPTION = ("oracle", "option")
ORACLE_DISCRETE = ("oracle", "discrete")
ORACLE_PARAMETERS = ("oracle", "parameters")

# Written by an environment with human data: the probability that people choose each option. Read by `human`.
HUMAN_OPTION = ("human", "option")
