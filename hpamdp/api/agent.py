"""A trained agent, as Python code uses it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import NonNegativeInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.api.arguments import flag, path_argument, problem_of, without_env_prefix
from hpamdp.api.export import export_onnx
from hpamdp.complaints import as_json, no_such
from hpamdp.config.components import TARGET, Component, component, name_of_passed
from hpamdp.config.compose import read
from hpamdp.config.errors import ConfigError, validated
from hpamdp.config.outside_jobs import composed
from hpamdp.config.schema import Config, EnvConfig
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.decisions import DecisionTracker, decision_tracker
from hpamdp.env.facts import SOURCE_SETTINGS
from hpamdp.messages import as_code
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.renamed import OF_EVALUATION, no_member
from hpamdp.run import checkpoint
from hpamdp.run.assemble import make_env, make_evaluation, option_length
from hpamdp.run.resume import warn_of_other_ranges
from hpamdp.settings import NumAtOnce, Settings
from hpamdp.specs import PAMDPSpecs


class _Asked(Settings):
    """The numbers that `Agent.evaluate` takes."""

    episodes: NumAtOnce
    seed: NonNegativeInt


class Agent:
    """A selector and its learners, trained at one problem. `hpamdp.train` and `hpamdp.load` return it.

    Attributes:
        specs: sizes and bounds of the problem.
        policy: a TensorDict module that writes `option`, if there is one to choose, and the action leaves. It explores
            unless TorchRL's `set_exploration_type` says otherwise.
        history: the rows of metrics of the training, each a dict of column and number; `pandas.DataFrame(history)`
            makes a table. Empty if it is unknown.
        observation_space, action_space: Gymnasium's spaces of the problem, which `act` reads and writes.
    """

    def __init__(
        self,
        config: Config,
        agent: HierarchicalAgent,
        env: PAMDPEnv,
        progress: Mapping[str, Any],
        history: Sequence[Mapping[str, float]] = (),
    ) -> None:
        self.specs: PAMDPSpecs = agent.specs
        self.policy: TensorDictModuleBase = agent.policy
        self.history = [dict(row) for row in history]
        self._config = config
        self._agent = agent
        self._env = env
        self._progress = progress
        self._form = env.gymnasium_form()
        self.observation_space = self._form.observation_space
        self.action_space = self._form.action_space
        self._tracker: DecisionTracker = decision_tracker(env, option_length=option_length(config))
        # What must stay from step to step: the selector's choices, and the state of the learners' policies.
        self._kept = [*agent.choice_keys, *agent.router.state_keys]
        self._last: TensorDictBase | None = None
        self._starts = self._starts_later = np.zeros(0, bool)

    def __repr__(self) -> str:
        frames = self._progress.get("frames")
        trained = "untrained" if not frames else f"after {frames:,} frames"
        return f"Agent({self._config.high}, {self._config.low}, {self._config.env}, {trained})"

    def __getattr__(self, name: str) -> Any:
        if hasattr(type(self), name):  # a property raised an AttributeError: raise it once more, from there
            return object.__getattribute__(self, name)
        raise no_member(self, name)

    @property
    def num_parameters(self) -> int:
        """Number of weights of all networks."""
        return sum(each.numel() for each in self._agent.parameters())

    def act(
        self, observation: Any, info: Mapping[str, Any] | None = None, *, greedy: bool = True, **unknown: Any
    ) -> Any:
        """Return the action for an observation, in Gymnasium's form.

        The agent holds its option, and what its policy remembers, until `reset` says that a new episode begins. Agents
        that hold nothing need no `reset`. In vectors that restart in the next step, the default of
        `gymnasium.make_vec`, say `reset(done, next_step=True)`. The agent cannot notice a wrong mode.

        Args:
            observation: one observation, or a batch, in which every leaf has a leading `[N]`.
            info: the info of the same step. Its masks count if the problem gives them there, and its `trip_ended` if
                options end with trips.
            greedy: whether to take the best action. Otherwise the agent explores as in training.
            unknown: refused, with the name that was probably meant.

        Raises:
            ValueError: an argument is wrong; the agent chooses by rewards, which `act` does not get; an agent that
                holds an option or memory gets a batch of another size; or an episode exceeds the problem's limit, so a
                `reset` is missing.

        Example:
            >>> import hpamdp
            >>> agent = hpamdp.load("hppo_platform")
            >>> env = hpamdp.make_gymnasium("platform")
            >>> observation, info = env.reset(seed=0)
            >>> discrete, parameters = agent.act(observation)
        """
        for name in unknown:
            raise ValueError(f"act: {name}: {no_such('argument', name, ('observation', 'info', 'greedy'))}")
        flag("act: greedy", greedy)
        if info is not None and not isinstance(info, Mapping):
            raise ValueError(f"act: info={as_code(info)}: must be a dict")
        try:
            fresh, is_batch = self._form.read(observation, info)
        except ValueError as error:
            raise ValueError(f"act: {error}") from error
        seen = self._seen(fresh.to(self._env.device))
        selector = self._agent.selector
        if selector is not None and keys.OPTION_RETURN in selector.in_keys:
            raise ValueError(f"act: {self._config.high} chooses by the rewards of earlier trips; use evaluate")
        exploration = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
        with acting(exploration), torch.no_grad():
            self._last = self.policy(seen)
        self._starts, self._starts_later = self._starts_later, np.zeros_like(self._starts)
        return self._form.write(self._last, is_batch=is_batch)

    def reset(self, starts: Any = None, *, next_step: bool = False) -> None:
        """Begin new episodes with the next `act`.

        No observation shows how a vector restarts its episodes, so `next_step` must say so. Otherwise an option or a
        memory is taken into the next episode.

        Args:
            starts: which of a batch begin, bool `[N]`, such as `terminated | truncated`. If None, all of them.
            next_step: whether the vector restarts them in its next step, as in the mode `NextStep`, the default of
                `gymnasium.make_vec`. The next `act` then still sees the old episode's last observation, and its action
                is ignored. The new episode begins with the `act` after it. `make_gymnasium` makes vectors that restart
                in the same step.

        Raises:
            ValueError: the mask does not fit the batch.

        Example:
            >>> import gymnasium, hpamdp
            >>> agent = hpamdp.load("hppo_platform")
            >>> vector = gymnasium.make_vec("hpamdp/Platform-v0", num_envs=4)
            >>> observations, infos = vector.reset(seed=0)
            >>> agent.reset()
            >>> observations, _, terminated, truncated, infos = vector.step(agent.act(observations))
            >>> agent.reset(terminated | truncated, next_step=True)
        """
        flag("reset: next_step", next_step)
        if starts is None:
            self._last = None
            return
        mask = np.asarray(starts)
        num = "N" if self._last is None else len(self._last)
        if mask.dtype != bool or mask.ndim != 1 or num not in ("N", len(mask)):
            raise ValueError(f"reset: starts must be bool [{num}], but is {as_code(starts)}")
        if self._last is not None and self._kept:
            self._starts |= mask
            if next_step:
                self._starts_later |= mask

    def _seen(self, fresh: TensorDict) -> TensorDictBase:
        """Return what the policy reads: new rows `[N]`, and what stays from the last step."""
        num = len(fresh)
        if not self._kept:  # every step is like a first one
            return fresh.set(keys.IS_DECISION, torch.ones(num, 1, dtype=torch.bool, device=fresh.device))
        if self._last is None:
            self._starts, self._starts_later = np.ones(num, bool), np.zeros(num, bool)
        elif len(self._last) != num:
            running = len(self._last)
            raise ValueError(f"act: got {num} observations, but {running} episodes are running; call reset() first")
        seen = self._tracker.follow(fresh, self._last, torch.from_numpy(self._starts.copy()).to(fresh.device))
        if self._last is None:
            return seen
        self._check_length(seen)
        for key in self._kept:
            value = self._last.get(key, None)
            if value is not None:
                seen.set(key, value)
        return seen

    def _check_length(self, seen: TensorDictBase) -> None:
        steps, longest = int(seen.get(keys.EPISODE_STEPS).max()), self._env.max_steps
        if steps >= longest:
            raise ValueError(
                f"act: {steps} steps without a reset(), but an episode has at most {longest}; call reset() when an "
                "episode begins"
            )

    def evaluate(
        self,
        env: Any = None,
        episodes: int = 100,
        *,
        seed: int | None = None,
        per_episode: bool = False,
        **settings: Any,
    ) -> dict[str, Any]:
        """Play episodes greedily and return their means.

        Args:
            env: another problem, as for `hpamdp.train`, with the same sizes. If None, the agent's own. If both have
                the same name and class, the settings that `env` does not give are those of the agent's own problem.
                This leaves out `id`, `entry_point` and `kwargs`.
            episodes: number of episodes.
            seed: of the episodes. If None, that of the agent's own evaluations, so 100 episodes are their first 100.
            per_episode: whether to return arrays with one entry for each episode instead of means.
            settings: of the problem, such as `max_steps=50`.

        Returns:
            The means by name: `score`, `return`, `steps`, and what else the problem measures, such as `success`.

        Raises:
            ConfigError: the problem has other sizes, or a number is wrong.
        """
        flag("per_episode", per_episode)
        for name in settings:
            if name in OF_EVALUATION:
                raise ConfigError(f"evaluate: {name}: no such argument; use {OF_EVALUATION[name]}")
        of_problem = without_env_prefix(settings)
        for name in EnvConfig.model_fields:
            if name in of_problem:
                raise ConfigError(f"{name}: a trained agent keeps the options that it has learned with; leave it out")
        config = self._config_at(env, of_problem)
        seed = config.run.eval.seed if seed is None else seed
        asked = {"episodes": episodes, "seed": seed}
        checked = validated(_Asked, asked, "", "argument", "hpamdp.Agent.evaluate")
        eval_config = config.run.eval.model_copy(update={"layouts": checked.episodes, "seed": checked.seed})
        evaluation = make_evaluation(config.with_run(eval=eval_config, film=False), self._env)
        try:
            played = evaluation.run(self.policy)
            return played if per_episode else evaluation.measure(played)
        finally:
            evaluation.env.close()

    def _config_at(self, env: Any, settings: Mapping[str, Any]) -> Config:
        """Return the agent's config at another problem; if `env` is None, at its own with other settings.

        Raises:
            ConfigError: the problem has other sizes, or a setting is wrong.
        """
        if env is None and not settings:
            return self._config
        if env is None:
            own = self._config.env
            assert own.cls is not None
            changed = component("env", own.name, {TARGET: name_of_passed(own.cls), **own.settings, **settings})
            return self._fitting(replace(changed, objects=own.objects))
        problem = problem_of(env)
        given = problem.with_settings((f"env.{name}", value) for name, value in settings.items())
        with composed(problem.words, given) as cfg:
            other = read(cfg).with_objects(problem.objects)
            grouping = other.run.env.grouping
            if grouping not in (None, self._config.run.env.grouping, self._env.grouping):
                raise ConfigError(
                    f"env.grouping={as_json(grouping)}: a trained agent keeps the options that it has learned with; "
                    "give a problem without a grouping"
                )
            own = self._config.env
            if other.env.cls is own.cls and other.env.name == own.name:
                left_out = {*SOURCE_SETTINGS, *(name.removeprefix("env.") for name, _ in given)}
                kept = {name: value for name, value in own.settings.items() if name not in left_out}
                other = replace(other, env=other.env.with_settings({**other.env.settings, **kept}))
        return self._fitting(other.env)

    def _fitting(self, env: Component) -> Config:
        """Return the agent's config at another problem with the same sizes.

        Raises:
            ConfigError: the problem has other sizes.
        """
        config = replace(self._config, env=env)
        with closing(make_env(config, 1, self._env.device, config.run.seed)) as built:
            specs = PAMDPSpecs.from_env(built)
        if specs != self.specs:
            both = [(each.name, getattr(specs, each.name), getattr(self.specs, each.name)) for each in fields(specs)]
            name, theirs, ours = next(each for each in both if each[1] != each[2])
            has = f"has {name}={as_code(theirs)}, but the agent's problem {as_code(ours)}"
            raise ConfigError(f"evaluate: {env} {has}")
        warn_of_other_ranges("evaluate: the agent", self._env.ranges(), built)
        return config

    def save(self, path: str | Path) -> None:
        """Write the agent to a file, which `hpamdp.load` reads; an existing file is replaced.

        The file holds the networks and the settings, not the replay buffer. To continue training, train with a folder.

        Raises:
            ConfigError: `path` is not a path.
            OSError: the file cannot be written, or the path is a folder or a pipe.
        """
        checkpoint.save_policy(path_argument("save", path), self._agent, self._env, self._progress)

    def export(self, path: str | Path) -> None:
        """Write the greedy policy to an ONNX file, which runs without torch; an existing file is replaced.

        The inputs are:

        - `observation`, float32 `[N, observation_dim]`;
        - the masks `action_mask` and `option_mask`, if the problem has them;
        - if the agent chooses options, `held_option`, int64 `[N]`, and `is_decision`, bool `[N]`;
        - if the agent also chooses their lengths, `held_length`, int64 `[N]`.

        The outputs are:

        - `discrete`, int64 `[N]`, or `[N, num_components]` if there are several components;
        - `parameters`, float32 `[N, num_parameters]`;
        - if the agent chooses options, `option`, int64 `[N]`;
        - if the agent also chooses their lengths, `option_length`, int64 `[N]`.

        Observations or parameters that float32 cannot hold are float64.
        The file scales observations as the agent does. Its properties name the actions and hold the parameters' bounds.
        They also give the numbers of the environment's first discrete actions and of its first option. The file counts
        both from 0.

        Raises:
            ConfigError: `path` is not a path, the agent has no greedy policy that can be exported, or `hpamdp[onnx]` is
                not installed.
            OSError: the file cannot be written, or the path is a folder or a pipe.

        Example:
            >>> import hpamdp
            >>> agent = hpamdp.load("hppo_platform")
            >>> agent.export("hppo_platform.onnx")  # doctest: +SKIP
            >>> import numpy, onnxruntime  # doctest: +SKIP
            >>> session = onnxruntime.InferenceSession("hppo_platform.onnx")  # doctest: +SKIP
            >>> observation = numpy.zeros((1, 9), numpy.float32)
            >>> discrete, parameters = session.run(None, {"observation": observation})  # doctest: +SKIP
        """
        about = {group: getattr(self._config, group).name for group in ("env", "high", "low")}
        export_onnx(path_argument("export", path), self._agent, self._env, option_length(self._config), about)
