"""The names under which data travels in tensordicts, once."""

OBSERVATION = "observation"
OPTION = "option"
ACTION = "action"
DISCRETE = (ACTION, "discrete")
PARAMETERS = (ACTION, "parameters")
REWARD = "reward"
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
OUTCOME, FUEL = "outcome", "fuel"

# Written by DecisionTracker.
IS_DECISION = "is_decision"
OPTION_RETURN, OPTION_STEPS = "option_return", "option_steps"
DECISION_OBSERVATION = "decision_observation"
EPISODE_RETURN, EPISODE_STEPS = "episode_return", "episode_steps"

# Written by an environment that knows the best action: what the `oracle` selector and the `planner` learner read.
ORACLE_OPTION = ("oracle", "option")
ORACLE_DISCRETE = ("oracle", "discrete")
ORACLE_PARAMETERS = ("oracle", "parameters")

# Written by an environment that knows what people do: their shares of the options, what the `human` selector reads.
HUMAN_OPTION = ("human", "option")

# Written by the agent for a selector that asks for it: what each option's learner expects of the state.
OPTION_VALUES = "option_values"
