"""Temporal abstraction: which steps are decisions, and the return of each option from its decision to its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Transform, TransformedEnv

from hpamdp import keys
from hpamdp.components import Components
from hpamdp.env.base import PAMDPEnv, ProblemError
from hpamdp.unchecked import unchecked

OptionLength: TypeAlias = float | Literal["chosen"] | None


class DecisionTracker(Transform):
    """Mark the steps at which an option is due and keep the return of the option that runs.

    Keys that it writes, `[*B, 1]` unless another shape is given:

    - `is_decision`, bool: in a step's root, the agent chooses an option at this step; under `next`, the option ended
      with this step.
    - `option_return`: sum of rewards since the option began, discounted by `gamma`, and `option_steps`, its number of
      steps.
    - `decision_observation` `[*B, observation_dim]`: the observation at which the option was chosen.
    - `option_ended`, bool, only with an `option_length` or `ends_with_trips`: under `next`, the option ended with this
      step by itself or with its trip, not only because its episode did.
    - `option_mask`, bool `[*B, num_options]`, only with `option_actions`: which options have an allowed action, of each
      component. Where the held option has none, it ends. Where an episode is over, masks that leave options no action
      may be opened (`action_mask_opened_at_end`).
    - `episode_return` and `episode_steps`: undiscounted sum of rewards and number of steps since the episode began.

    The rows where `("next", "is_decision")` is True are the transitions of the semi-MDP. All state travels in the
    tensordict, so an option may span several collected batches.

    Source: Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 3.

    Args:
        gamma: discount of an environment step within the option.
        option_length: steps after which an option ends, unless its episode or trip ends first. If None, an option lasts
            until then. If `math.inf`, the selector ends it: it sets `is_decision` in the root of the step at
            which it chooses again. If "chosen", the policy writes the number of steps of each option under
            `option_length`, int64 `[*B]`.
        option_actions: the discrete actions of each option, bool `[num_options, num_discrete]`, if options are sets of
            actions and some may be forbidden; else None.
        components: components of the action. If None, it has one.
        ends_with_trips: whether options end with the trips inside their episodes, see `ProblemCard.has_trips`.
        keeps_observation: whether to write `decision_observation`. Pictures are large, so they are kept only if there
            are options to choose.
    """

    def __init__(
        self,
        gamma: float = 1.0,
        option_length: OptionLength = None,
        option_actions: Tensor | None = None,
        *,
        components: Components | None = None,
        ends_with_trips: bool = False,
        keeps_observation: bool = True,
    ) -> None:
        super().__init__()
        self.gamma = gamma
        self.option_length = option_length
        self.option_actions = option_actions
        self.components = components
        self.ends_with_trips = ends_with_trips
        self.ends_inside = option_length is not None or ends_with_trips
        self.keeps_observation = keeps_observation

    def follow(self, fresh: TensorDictBase, before: TensorDictBase | None, begins: Tensor) -> TensorDictBase:
        """Return observed states `[N]` with the tracked entries, for a caller who steps the environments elsewhere.

        The rewards of the steps before are not known and count as 0.

        Args:
            fresh: what was observed: `observation` and the masks that the environment writes.
            before: the states before, with what the policy has written there. If None, all episodes begin.
            begins: in which rows an episode begins, bool `[N]`.
        """
        never = torch.zeros(*fresh.batch_size, 1, dtype=torch.bool, device=fresh.device)
        fresh = fresh.copy().update({keys.DONE: never, keys.TERMINATED: never})
        begun = self._reset(fresh.empty(), fresh.copy())
        if before is None:
            return begun
        going = self._step(before, fresh.set(keys.REWARD, never.float())).exclude(keys.REWARD)
        return begun.apply(lambda new, old: torch.where(_like(begins, new), new, old), going)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the keys that the tracker writes."""
        shape = (*observation_spec.shape, 1)
        device = observation_spec.device
        observation_spec[keys.IS_DECISION] = Binary(n=1, shape=shape, dtype=torch.bool, device=device)
        if self.ends_inside:
            observation_spec[keys.OPTION_ENDED] = observation_spec[keys.IS_DECISION].clone()
        for name in (keys.OPTION_RETURN, keys.EPISODE_RETURN):
            observation_spec[name] = Unbounded(shape=shape, device=device, dtype=torch.float32)
        for name in (keys.OPTION_STEPS, keys.EPISODE_STEPS):
            observation_spec[name] = Unbounded(shape=shape, dtype=torch.long, device=device)
        if self.keeps_observation:
            observation_spec[keys.DECISION_OBSERVATION] = observation_spec[keys.OBSERVATION].clone()
        if self.option_actions is not None:
            num_options = len(self.option_actions)
            mask_shape = (*observation_spec.shape, num_options)
            observation_spec[keys.OPTION_MASK] = Binary(num_options, shape=mask_shape, dtype=torch.bool, device=device)
        return observation_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Begin an option in every row; TorchRL restores the rows of the environments that were not reset."""
        observation = tensordict_reset.get(keys.OBSERVATION)
        is_decision = torch.ones_like(tensordict_reset.get(keys.DONE))
        zeros = torch.zeros(is_decision.shape, device=observation.device, dtype=torch.float32)
        if self.ends_inside:
            tensordict_reset.set(keys.OPTION_ENDED, torch.zeros_like(is_decision))
        if self.option_actions is not None:
            has_action = self._has_action(tensordict_reset, self.option_actions)
            tensordict_reset.set(keys.OPTION_MASK, _possible_options(tensordict_reset, has_action))
        if self.keeps_observation:
            tensordict_reset.set(keys.DECISION_OBSERVATION, observation)
        return tensordict_reset.update(
            {
                keys.IS_DECISION: is_decision,
                keys.OPTION_RETURN: zeros,
                keys.OPTION_STEPS: zeros.long(),
                keys.EPISODE_RETURN: zeros.clone(),
                keys.EPISODE_STEPS: zeros.long(),
            }
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        """Add this step to the sums of its option and its episode."""
        is_stuck = self._set_masks(tensordict, next_tensordict)
        for name, entry in self.tracked(tensordict, next_tensordict, is_stuck).items():
            next_tensordict.set(name, entry)
        return next_tensordict

    def tracked(
        self, tensordict: TensorDictBase, after: TensorDictBase, is_stuck: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the tracked entries of what followed a step, apart from the masks.

        Args:
            tensordict: the states `[*B]` with their actions and tracked entries.
            after: what followed.
            is_stuck: where the held option is not possible any more, bool `[*B, 1]`. If None, nowhere.
        """
        reward = after.get(keys.REWARD)
        done = after.get(keys.DONE)
        option_return = tensordict.get(keys.OPTION_RETURN)
        option_steps = tensordict.get(keys.OPTION_STEPS)
        entries: dict[str, Tensor] = {}
        is_decision = done.clone()
        if self.ends_inside:
            # Only a reset writes zeros: an option that begins inside an episode restarts its sums here.
            is_first = tensordict.get(keys.IS_DECISION)
            option_return = option_return.masked_fill(is_first, 0)
            option_steps = option_steps.masked_fill(is_first, 0)
            option_ended = torch.zeros_like(done)
            if self.option_length is not None:
                length = self.option_length
                if length == "chosen":
                    length = tensordict[keys.OPTION_LENGTH].unsqueeze(-1)
                option_ended = option_steps + 1 >= length
                if is_stuck is not None:
                    option_ended = option_ended | is_stuck
            if self.ends_with_trips:
                option_ended = option_ended | after.get(keys.TRIP_ENDED)
            is_decision = done | option_ended
            entries[keys.OPTION_ENDED] = option_ended
        entries[keys.IS_DECISION] = is_decision
        gained = reward if self.gamma == 1.0 else self.gamma ** option_steps.float() * reward
        entries[keys.OPTION_RETURN] = option_return + gained
        entries[keys.OPTION_STEPS] = option_steps + 1
        if self.keeps_observation:
            entries[keys.DECISION_OBSERVATION] = self._decision_observation(tensordict)
        entries[keys.EPISODE_RETURN] = tensordict.get(keys.EPISODE_RETURN) + reward
        entries[keys.EPISODE_STEPS] = tensordict.get(keys.EPISODE_STEPS) + 1
        return entries

    def restarted(self, root: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the tracked entries of the states to go on from.

        Args:
            root: entries of these states `[N]`, with new episodes where the step ended one.
            after: entries of what followed the step, with the tracked ones.
        """
        done = after[keys.DONE]
        sums = (keys.OPTION_RETURN, keys.OPTION_STEPS, keys.EPISODE_RETURN, keys.EPISODE_STEPS)
        entries = {name: after[name].masked_fill(done, 0) for name in sums}
        entries[keys.IS_DECISION] = after[keys.IS_DECISION]
        if self.ends_inside:
            entries[keys.OPTION_ENDED] = after[keys.OPTION_ENDED] & ~done
        if self.keeps_observation:
            seen = root[keys.OBSERVATION], after[keys.DECISION_OBSERVATION]
            entries[keys.DECISION_OBSERVATION] = torch.where(done, *seen)
        return entries

    def _decision_observation(self, tensordict: TensorDictBase) -> Tensor:
        """Return the observation at which the option of this step was chosen, `[*B, observation_dim]`."""
        decision_observation: Tensor = tensordict.get(keys.DECISION_OBSERVATION)
        if not self.ends_inside:
            return decision_observation.clone()
        return torch.where(tensordict.get(keys.IS_DECISION), tensordict.get(keys.OBSERVATION), decision_observation)

    def _set_masks(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor | None:
        """Write the masks of the next states; return where the held option is not possible, `[*B, 1]`.

        Return None if no option may be forbidden.

        Raises:
            ProblemError: the held option has no allowed action left, and its episode or trip, which it should last as
                long as, goes on.
        """
        if self.option_actions is None:
            return None
        option = tensordict.get(keys.OPTION)
        has_action = self._has_action(next_tensordict, self.option_actions)
        possible = _possible_options(next_tensordict, has_action)
        next_tensordict.set(keys.OPTION_MASK, possible)
        if keys.ACTION_MASK in next_tensordict.keys():
            held = option if self.option_length is None else None
            action_mask = action_mask_opened_at_end(next_tensordict, has_action, self.option_actions, held)
            next_tensordict.set(keys.ACTION_MASK, action_mask)
        if (pair_mask := next_tensordict.get(keys.PAIR_MASK, None)) is not None:
            is_open = _is_open_at_end(next_tensordict, has_action)
            next_tensordict.set(keys.PAIR_MASK, pair_mask | is_open.unsqueeze(-1))
        is_stuck = ~possible.gather(-1, option.unsqueeze(-1))
        if self.option_length is None:
            cannot_end = is_stuck & ~next_tensordict.get(keys.DONE)
            if self.ends_with_trips:
                cannot_end = cannot_end & ~next_tensordict.get(keys.TRIP_ENDED)
            if cannot_end.any():
                row = int(cannot_end.flatten().nonzero()[0])
                lifetime = "trips" if self.ends_with_trips else "episodes"
                raise ProblemError(
                    f"environment {row}: option {option.flatten()[row].item()} has no allowed action left, and options "
                    f"last as long as their {lifetime}; use agent.termination=steps, learned or chosen"
                )
        return is_stuck

    def _has_action(self, tensordict: TensorDictBase, option_actions: Tensor) -> Tensor:
        """Return which options have an allowed action of each component, bool `[*B, num_options]`."""
        allowed = option_actions.expand(*tensordict.batch_size, *option_actions.shape)
        if (action_mask := tensordict.get(keys.ACTION_MASK, None)) is not None:
            allowed = allowed & action_mask.unsqueeze(-2)
        if self.components is None:
            return allowed.any(-1)
        pair_mask = tensordict.get(keys.PAIR_MASK, None)
        return self.components.leaves_any(allowed, None if pair_mask is None else pair_mask.unsqueeze(-3))


def _possible_options(tensordict: TensorDictBase, has_action: Tensor) -> Tensor:
    """Return which options may be chosen in a state, bool `[*B, num_options]`: those with an allowed action.

    After a termination all options may be chosen. After a truncation all may if none has an action.

    Raises:
        ProblemError: none has an action where the episode goes on.
    """
    all_lack_action = ~has_action.any(-1, keepdim=True)
    is_refused = (all_lack_action & ~tensordict.get(keys.DONE)).flatten()
    if is_refused.any():
        row = int(is_refused.nonzero()[0])
        masks = " and ".join(name for name in (keys.ACTION_MASK, keys.PAIR_MASK) if name in tensordict.keys())
        raise ProblemError(
            f"environment {row}: no option has an action that its {masks} allows; give the options more actions"
        )
    return has_action | all_lack_action | tensordict.get(keys.TERMINATED)


def action_mask_opened_at_end(
    after: TensorDictBase, has_action: Tensor, option_actions: Tensor, held: Tensor | None
) -> Tensor:
    """Return the action mask of states `[*B]`, opened where an episode is over and options would have no action.

    The value of a state is that of its best action. Without any action it is -inf, which is no value to learn from.
    After a termination that leaves an option no action, all actions are allowed, since the value is multiplied by 0.
    After a truncation it counts. There all actions are allowed only if no option has one. Otherwise, if the held option
    has none and cannot end, its own actions are allowed. So evaluations, which play on in episodes that have ended,
    find an action of each possible option.

    Args:
        after: `action_mask`, `done` and `terminated` of the states.
        has_action: which options have an allowed action, bool `[*B, num_options]`.
        option_actions: the discrete actions of each option, bool `[num_options, num_discrete]`.
        held: the held options, int64 `[*B]`, if they last as long as the episode. If None, those without an action end.
    """
    action_mask: Tensor = after.get(keys.ACTION_MASK) | _is_open_at_end(after, has_action)
    if held is None:
        return action_mask
    is_stuck = after.get(keys.DONE) & ~has_action.gather(-1, held.unsqueeze(-1))
    return action_mask | (is_stuck & option_actions[held])


def _is_open_at_end(after: TensorDictBase, has_action: Tensor) -> Tensor:
    """Return in which states `[*B]` everything is allowed because the episode is over there, bool `[*B, 1]`."""
    some_lack_action = ~has_action.all(-1, keepdim=True)
    all_lack_action = ~has_action.any(-1, keepdim=True)
    return (after.get(keys.TERMINATED) & some_lack_action) | (after.get(keys.DONE) & all_lack_action)


def _like(mask: Tensor, value: Tensor) -> Tensor:
    return mask.reshape(-1, *[1] * (value.ndim - 1))


def _zeroed(leaves: Mapping[str, Any], mask: Tensor) -> dict[str, Any]:
    """Return entries, some of them nested, with zeros where the mask `[N, 1]` is true."""
    return {
        name: unchecked(_zeroed(dict(leaf.items()), mask), leaf)
        if isinstance(leaf, TensorDictBase)
        else leaf.masked_fill(_like(mask, leaf), 0)
        for name, leaf in leaves.items()
    }


class DecisionEnv(TransformedEnv):
    """An environment whose decisions are tracked; its `reset` takes the same keys as the environment's own."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # Like TransformedEnv's, except that it passes on more than the mask: layouts and seeds to start from.
        given = None if tensordict is None else tensordict.copy()
        given = self.transform._reset_env_preprocess(given)
        fresh = self.base_env._reset(given, **kwargs)
        self.base_env._complete_done(self.base_env.full_done_spec, fresh)
        self._problem.check_masks(fresh)
        return self.transform._reset(fresh.empty() if given is None else given, fresh)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._problem.check_masks(super()._step(tensordict))

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        tracker = self.transform
        assert isinstance(tracker, DecisionTracker)
        both = self._problem.step_and_restart(tensordict) if tracker.option_actions is None else None
        if both is None:
            return super()._step_and_maybe_reset(tensordict)
        after, root = (dict(each.items()) for each in both)
        after |= tracker.tracked(tensordict, both[0])
        root |= tracker.restarted(root, after)
        # As in TorchRL, the root keeps what the policy wrote, with zeros where an episode begins.
        kept = {name: leaf for name, leaf in tensordict.items() if name not in root}
        root |= _zeroed(kept, after[keys.DONE])
        return tensordict.set("next", unchecked(after, tensordict)), unchecked(root, tensordict)

    @property
    def _problem(self) -> PAMDPEnv:
        assert isinstance(self.base_env, PAMDPEnv)
        return self.base_env


def decision_tracker(env: PAMDPEnv, gamma: float = 1.0, option_length: OptionLength = None) -> DecisionTracker:
    """Return a tracker for this environment; arguments as for `DecisionTracker`.

    Raises:
        ProblemError: it has trips, but does not say where they end.
    """
    if env.card.has_trips and keys.TRIP_ENDED not in env.observation_spec.keys():
        raise ProblemError(f"{env.title}: has_trips is true, but its observation_spec has no {keys.TRIP_ENDED}")
    option_actions = None
    observed = env.observation_spec.keys()
    if env.option_actions is not None and (keys.ACTION_MASK in observed or keys.PAIR_MASK in observed):
        option_actions = torch.tensor(env.option_actions, device=env.device)
    keeps_observation = env.has_choice or not env.observation_entries
    return DecisionTracker(
        gamma,
        option_length,
        option_actions,
        components=env.components,
        ends_with_trips=env.card.has_trips and env.has_choice,
        keeps_observation=keeps_observation,
    )


def with_decisions(env: PAMDPEnv, gamma: float = 1.0, option_length: OptionLength = None) -> DecisionEnv:
    """Return the environment with its decisions tracked; arguments and errors as for `decision_tracker`."""
    return DecisionEnv(env, decision_tracker(env, gamma, option_length))
