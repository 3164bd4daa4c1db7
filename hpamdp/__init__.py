"""A research framework for hierarchical and parameterised-action reinforcement learning.

The names below are all that a user needs. Everything else is internal and may change between versions.

- `make`, `make_gymnasium`: a problem as a TorchRL or as a Gymnasium environment.
- `train`, `load`: train an agent, or load a trained one. Both return an `Agent`, which acts, is evaluated and saved.
- `report`: statistics over seeds of the runs in a folder. `judge`: what recorded transitions say of trained agents.
- `Callback`: the base of code that runs during training. `BestAgent`, `Patience`, `TimeLimit` and `OwnMetrics` are
  callbacks to choose from.
- `PAMDPSpecs`: sizes and bounds of a problem, `PAMDPSpecs.from_env(env)`. Learners and selectors are built from it.
- Learners, such as `HPPO`, and selectors, such as `UCB`: `dir(hpamdp)` lists them.
- `PAMDPEnv`, `Learner`, `Selector`: the bases of a problem, a learner and a selector of your own.
- `ConfigError`: raised for a user's mistake, with one line that says what is allowed. `DivergedError`: raised if
  training reaches numbers that are not finite. `EnvironmentFaultError`: raised if an environment's own code fails.

Importing this package registers the Gymnasium ids of its problems. It loads neither torch nor TorchRL until one of the
names is used.
"""

import sys
from typing import Any

import lazy_loader

from hpamdp.imports import collector_paused
from hpamdp.renamed import no_member
from hpamdp.search_path import is_command_line, put_working_directory_last

__version__ = "0.3.0"
# `__init__.pyi` lists the names with their modules, which are imported when a name is used.
_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise no_member(sys.modules[__name__], name)
    with collector_paused():
        value = _imported(name)
    globals()[name] = value  # so that it is looked up once
    return value


if is_command_line():
    # `python -m` puts the working directory first, and the next import needs other packages.
    put_working_directory_last()
else:
    # The command line leaves this to `env=gymnasium`: importing Gymnasium takes longer than refusing a wrong setting.
    from hpamdp.env.registration import register

    register()
