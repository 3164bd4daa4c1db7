"""The contract of a data set to learn from, and the option sums that its transitions need."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.row_checks import (
    PERSON,
    TRAJECTORY,
    check_actions,
    check_decisions,
    check_observations,
    check_options,
    check_returns,
    check_transitions,
)
from hpamdp.devices import checked_device
from hpamdp.env.decisions import action_mask_opened_at_end
from hpamdp.specs import PAMDPSpecs


class Demonstrations:
    """Transitions to learn from, as if they had been collected from the environment at hand.

    For a recording of your own, write a subclass and choose it in `conf/data`. Its constructor takes the environment
    as `env`, beside the settings of its yaml, and passes its transitions to this constructor, which checks the values.
    A run then compares them with its environment by `check`. Options last a whole episode.

    Args:
        transitions: `[M]`, one episode after another, with ascending episode numbers under `TRAJECTORY`. At the root
            `observation`, the action leaves, `is_decision` and, if the agent chooses options, `option`; under
            `next` `observation`, `reward`, `done`, `terminated`, `truncated` and `is_decision`; shapes and types are
            the environment's. The last row of each episode is `done`, and no other row. Parameters of discrete actions
            that a row does not take may be 0. `action_mask` and `option_mask` are optional, at the root and under
            `next`; without them learners take all actions and options as allowed. After the end of an episode a mask
            may allow nothing; `check` opens it.
            `pair_mask`, `parameter_low` and `parameter_high` are required if the environment gives them.
            `("next", "duration")`, finite and at least 0, goes with environments whose steps take different times.
            Without it learners discount all these steps alike. `person` `[M]` int64 is the number of who acted.
        device: where the tensors are kept.
        decisions: `[K]`, for selectors, if more is known of the options' returns than the transitions show. At the root
            `option`; under `next` `decision_observation`, `option_return`, `option_steps`, `observation`, `done` and
            `is_decision`, which is true. If None, selectors learn from the decisions in the transitions.
        held_out: numbers of people whose transitions and decisions nothing learns from. Both then need a `person`.

    Attributes:
        batch: the transitions `[1, M]`, with the sums that `with_option_sums` adds.
        decisions: `[1, K]` or None.
        held_out: the transitions that nothing learns from, `[1, H]`; None if there are none.

    Raises:
        SettingError: this machine does not have the device.
        DataError: a key is missing, the episodes are out of order, or a value is wrong; the message names its row. Or
            a held-out person is not in the data, or nobody else is.
    """

    batch: TensorDict
    decisions: TensorDict | None
    held_out: TensorDict | None

    def __init__(
        self,
        transitions: TensorDict,
        device: torch.device | str | None = None,
        *,
        decisions: TensorDict | None = None,
        held_out: Sequence[int] = (),
    ) -> None:
        device = None if device is None else checked_device(self, device)
        check_transitions(transitions)
        with_sums = with_option_sums(transitions)
        check_returns(with_sums)
        self.held_out = self.decisions = None
        if held_out:
            with_sums, held_out_rows = _split("the transitions", with_sums, held_out)
            self.held_out = _batch(held_out_rows, device)
        self.batch = _batch(with_sums, device)
        if decisions is not None:
            check_decisions(decisions)
            decisions = _split("the decisions", decisions, held_out)[0] if held_out else decisions
            self.decisions = _batch(decisions, device)

    def check(
        self, specs: PAMDPSpecs, observation_bounds: tuple[Sequence[float], Sequence[float]] | None = None
    ) -> None:
        """Check that every row is possible in an environment with these specs and bounds, `[observation_dim]` each.

        If a mask allows nothing after the end of an episode, it is opened, as in environments.

        Raises:
            DataError: a row is impossible; the message names the first one.
        """
        check_actions(self.batch.squeeze(0), specs)
        if observation_bounds is not None:
            check_observations("the transitions", self.batch.squeeze(0), *observation_bounds)
        self.batch = _with_open_masks(self.batch, specs)
        if self.held_out is not None:
            check_actions(self.held_out.squeeze(0), specs)
            self.held_out = _with_open_masks(self.held_out, specs)
        if self.decisions is not None and specs.num_options:
            check_options("the decisions", self.decisions.squeeze(0), specs)
            self.decisions = _with_open_masks(self.decisions, specs)

    def discount(self, gamma: float) -> None:
        """Discount the option returns by `gamma` a step, as a selector asks for.

        Raises:
            DataError: the returns of given decisions are known only as they are.
        """
        if gamma == 1.0:
            return
        if self.decisions is not None:
            raise DataError("its decisions' returns are known only undiscounted; use 1")
        self.batch = with_option_sums(self.batch.squeeze(0), gamma).unsqueeze(0)


def _split(what: str, rows: TensorDict, held_out: Sequence[int]) -> tuple[TensorDict, TensorDict]:
    """Return the rows `[N]` of the people who are not held out, and those of the people who are."""
    if PERSON not in rows.keys():
        raise DataError(f"held_out: {what} do not say who acted ({PERSON})")
    person = rows[PERSON]
    absent = set(held_out).difference(person.tolist())
    if absent:
        raise DataError(f"held_out: {what} have nobody with the number {min(absent)}")
    is_held_out = torch.isin(person, torch.tensor(held_out, device=person.device))
    if is_held_out.all():
        raise DataError(f"held_out: {what} are of nobody else")
    return rows[~is_held_out], rows[is_held_out]


def _with_open_masks(batch: TensorDict, specs: PAMDPSpecs) -> TensorDict:
    """Return rows `[1, N]` whose masks after the end of an episode are opened where they allow nothing.

    Environments do the same (`PAMDPEnv.check_masks`, `action_mask_opened_at_end`). An action mask allows nothing if a
    component, or an option that is a set of actions, has no discrete action left. Options last a whole episode.
    """
    batch = batch.copy()
    after = batch["next"]
    if keys.ACTION_MASK in after.keys() and keys.TERMINATED in after.keys():
        everything = ((True,) * specs.num_discrete,)
        option_actions = torch.tensor(specs.option_actions or everything, device=after[keys.ACTION_MASK].device)
        held = batch[keys.OPTION] if specs.option_actions else None
        has_action = specs.components.any_of_each(after[keys.ACTION_MASK].unsqueeze(-2) & option_actions)
        after[keys.ACTION_MASK] = action_mask_opened_at_end(after, has_action, option_actions, held)
    if keys.OPTION_MASK in after.keys():
        is_empty = ~after[keys.OPTION_MASK].any(-1, keepdim=True)
        after[keys.OPTION_MASK] = after[keys.OPTION_MASK] | (after[keys.DONE] & is_empty)
    return batch


def _batch(rows: TensorDict, device: torch.device | None) -> TensorDict:
    batch = rows.unsqueeze(0)
    return batch if device is None else batch.to(device)


def with_option_sums(transitions: TensorDict, gamma: float = 1.0) -> TensorDict:
    """Return the transitions with what `DecisionTracker` writes if an option lasts a whole episode.

    It is under `next`:
    - `option_return` `[N, 1]`: the discounted sum of the rewards since the episode began;
    - `option_steps` `[N, 1]`: the number of these steps;
    - `decision_observation` `[N, observation_dim]`: the episode's first observation.

    Args:
        transitions: `[N]`, one episode after another, with ascending episode numbers under `TRAJECTORY`.
        gamma: discount of a step.
    """
    episode = transitions[TRAJECTORY]
    first = torch.searchsorted(episode, episode)  # the row in which each row's episode begins
    option_steps = torch.arange(len(first), device=first.device) - first + 1
    # Double precision, because the sum runs over all episodes before it is taken apart.
    reward = gamma ** (option_steps - 1).double() * transitions["next", keys.REWARD].squeeze(-1).double()
    total = reward.cumsum(0)
    option_return = total - total[first] + reward[first]
    extended = transitions.copy()
    extended["next", keys.OPTION_RETURN] = option_return.float().unsqueeze(-1)
    extended["next", keys.OPTION_STEPS] = option_steps.unsqueeze(-1)
    extended["next", keys.DECISION_OBSERVATION] = transitions[keys.OBSERVATION][first]
    return extended
