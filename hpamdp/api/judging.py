"""Judge trained agents by recorded transitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hpamdp.api.arguments import count, path_argument
from hpamdp.commands.judge import DEFAULT_EPISODES, judged


def judge(
    *agents: str | Path, data: str, episodes: int = DEFAULT_EPISODES, compare: bool = False, **settings: Any
) -> list[dict[str, Any]]:
    """Return what recorded transitions say of trained agents, as `hpamdp judge` prints it.

    An ensemble (`low=pets`) learns the recorded transitions and rolls the agents out. No environment is stepped.

    Args:
        agents: folders of runs, or names of agents that come with the package, all of one problem.
        data: the data set, such as `human`. If the agents' runs hold out the same transitions, these are taken.
        episodes: recorded episodes from whose first transitions the agents act.
        compare: whether to estimate the returns by two other methods, too; the order stays that of the roll-outs.
        settings: further settings of `mode=offline low=pets`, such as `**{"data.held_out": [3, 4]}`.

    Returns:
        A row for each agent, the highest return first:
        - `agent`; `return`: the mean undiscounted return;
        - `interval`: its 95 % interval (Student's t) over people, or over starts if the data tell of no people;
        - `between_members`: standard deviation of the mean over the members of the ensemble;
        - `coverage`: fraction of the actions that are like a recorded one in a recorded state;
        - `steps`, and `unfinished`: probability that an episode lasts longer than all recorded ones;
        - `doubts`: what the data cannot tell;
        - with `compare=True`, also `fitted`: the mean return by fitted Q evaluation; `importance`: the mean return by
          weighted importance sampling; `effective`: the effective number of episodes behind `importance`. NaN if a
          method cannot tell.

    Raises:
        ConfigError: an argument is wrong, an agent does not exist, or the data cannot judge it.

    Example:
        >>> import hpamdp
        >>> rows = hpamdp.judge("outputs/a", "outputs/b", data="human")  # doctest: +SKIP
    """
    count("episodes", episodes)
    paths = [str(path_argument("agents", agent)) for agent in agents]
    return judged(paths, [f"data={data}"], list(settings.items()), episodes=episodes, compare=compare)
