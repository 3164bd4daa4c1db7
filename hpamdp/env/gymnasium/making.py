"""Make one copy of a Gymnasium environment from its settings, and explain what is wrong with them in one line."""

from __future__ import annotations

import copy
import importlib
import multiprocessing
import traceback
from collections.abc import Callable
from typing import Any

import gymnasium
from torchrl.envs import EnvBase

from hpamdp.env.errors import ProblemError, fault_of
from hpamdp.env.gymnasium.contract import checked
from hpamdp.env.gymnasium.from_torchrl import FromTorchRL
from hpamdp.messages import one_line
from hpamdp.settings import SettingError

# What environments of PettingZoo and RLlib have.
_OF_SEVERAL_AGENTS = ("possible_agents", "agents", "agent_iter", "get_agent_ids")


class Maker:
    """Makes copies of a Gymnasium environment.

    Args:
        name: what errors call the environment.
        id: its registered name, or None.
        entry_point: instead, the class or function that returns it: its name, or itself.
        kwargs: arguments of its constructor.
        max_steps: time limit that `gymnasium.make` applies; None: the registered one.
    """

    def __init__(
        self,
        name: str,
        id: str | None,
        entry_point: str | Callable[..., Any] | None,
        kwargs: dict[str, Any] | None,
        max_steps: int | None,
    ) -> None:
        self.name = name
        self._id = id
        self._entry_point = entry_point
        self._kwargs = kwargs or {}
        self._max_steps = max_steps

    def __call__(self) -> gymnasium.Env:
        """Return another copy.

        Raises:
            SettingError: there is no such environment, or it does not take these arguments.
            EnvironmentFaultError: its constructor raised an error.
        """
        # The copies of the environment must not share what they may change.
        kwargs = copy.deepcopy(self._kwargs)
        try:
            if self._entry_point is None:
                assert self._id is not None  # checked with the settings
                env = gymnasium.make(self._id, max_episode_steps=self._max_steps, disable_env_checker=True, **kwargs)
            else:
                env = self._load(self._entry_point)(**kwargs)
        except (gymnasium.error.Error, ImportError) as error:
            cure = ""
            if isinstance(error, gymnasium.error.NameNotFound) and multiprocessing.parent_process() is not None:
                cure = (
                    " This is a worker process; name the module that registers it, as module:Name-v0, or pass the class"
                )
            raise SettingError(f"{self.name}: {one_line(error)}{cure}") from error
        except SettingError as error:  # of `_load`, or of a class with Options
            raise SettingError(f"{self.name}: {error}") from error
        except (ProblemError, MemoryError):
            raise
        except Exception as error:
            self._refuse_arguments(error, kwargs)
            fault = fault_of(error, f"{self.name}: its constructor")
            if fault is None:
                raise
            raise fault from error
        return self._checked(env)

    def _checked(self, env: Any) -> gymnasium.Env:
        """Return what a class or function made as an environment that checks its contract."""
        if isinstance(env, type):
            raise SettingError(f"{self.name}: returned the class {env.__name__}, not an environment; call it")
        if isinstance(env, EnvBase):
            try:
                env = FromTorchRL(env)
            except SettingError as error:
                raise SettingError(f"{self.name}: {error}") from error
        if not isinstance(env, gymnasium.Env):
            cure = "wrap an environment of gym with shimmy's GymV21CompatibilityV0"
            if any(hasattr(env, name) for name in _OF_SEVERAL_AGENTS):
                cure = "one of several agents needs a gymnasium.Env around it that acts for the others"
            elif isinstance(env, gymnasium.vector.VectorEnv):
                cure = "give a single one, of which num_envs makes copies"
            raise SettingError(
                f"{self.name}: {type(env).__name__} is no environment, because it does not inherit from gymnasium.Env; "
                f"{cure}"
            )
        for space in ("action_space", "observation_space"):
            if not hasattr(env, space):
                raise SettingError(f"{self.name}: {type(env).__name__} has no {space}")
        return checked(env)

    def _load(self, entry_point: str | Callable[..., Any]) -> Any:
        if not isinstance(entry_point, str):
            return entry_point
        module_name, _, name = entry_point.partition(":")
        if not all(part.isidentifier() for part in (*module_name.split("."), name)):
            raise SettingError("must be a class or function, as package.module:name")
        entry = getattr(importlib.import_module(module_name), name, None)
        if not callable(entry):
            raise SettingError(f"there is no class or function {name} in {module_name}")
        return entry

    def _refuse_arguments(self, error: Exception, kwargs: dict[str, Any]) -> None:
        """Raise a refusal if an error is about the arguments of the constructor."""
        cause = error.__cause__ or error  # Gymnasium raises a constructor's error again, from the original one
        # A constructor may pass unknown arguments on to another one, which then raises the error.
        is_unknown = any(f"unexpected keyword argument '{name}'" in str(cause) for name in kwargs)
        if isinstance(cause, TypeError | ValueError) and (is_unknown or _is_about_the_call(cause)):
            raise SettingError(f"{self.name}: {one_line(cause)}") from error


def _is_about_the_call(error: BaseException) -> bool:
    """Return whether an error is about a call's arguments or a registered time limit: raised here or in Gymnasium."""
    frame, _ = list(traceback.walk_tb(error.__traceback__))[-1]
    return frame.f_globals["__name__"] in (__name__, "gymnasium.envs.registration", "gymnasium.wrappers.common")
