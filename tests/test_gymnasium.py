"""GymnasiumEnv passes on exactly the chosen actions and keeps the framework's contract."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium_players import TOY, action, make, reset_rows, step
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from toy_environments import ALL, FORMS, Toy, native_action

from hpamdp.config.components import component
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import ProblemError
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.specs import PAMDPSpecs


def native(env: GymnasiumEnv, row: int = 0) -> list:
    return env.envs[row].unwrapped.actions


def equal(one, other) -> bool:
    """Return whether two nested actions are equal, with their shapes and dtypes."""
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(equal, one, other))
    return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other)


@pytest.mark.parametrize("form", FORMS)
def test_the_environment_receives_the_chosen_action(form):
    env = make(2, form=form, max_steps=1000)
    assert env.parameter_dims == ((2, 2, 2) if form == "shared" else (2, 0, 1))
    specs = PAMDPSpecs.from_env(env)
    assert (specs.num_discrete, specs.parameter_dims) == (3, env.parameter_dims)
    low, high = ([-1.0, 10.0] * 3, [1.0, 30.0] * 3) if form == "shared" else (ALL.low, ALL.high)
    assert np.allclose(specs.parameter_low, low) and np.allclose(specs.parameter_high, high)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        discrete = torch.randint(3, (2,), generator=generator)
        # Well inside the bounds, where nothing is clipped.
        unit = 0.9 * (2.0 * torch.rand(2, specs.num_parameters, generator=generator) - 1.0)
        parameters = specs.from_unit(unit)
        step(env, discrete, parameters)
        for row in range(2):
            assert equal(native(env, row)[-1], native_action(form, int(discrete[row]), parameters[row].numpy()))


def test_all_tensors_are_as_the_specs_say():
    # Toy refuses actions outside its space, and samples of the specs have rounded bounds.
    check_env_specs(make(3, max_steps=2), return_contiguous=True)


def test_values_outside_their_bounds_are_clipped():
    env = make(2)
    env.reset()
    step(env, [0, 2], [[9.0, -9.0, 9.0], [-9.0, 99.0, -9.0]])
    step(env, [2, 0], [[np.nan, np.inf, 0.3], [0.5, 20.0, np.nan]])
    assert [[part.ravel().tolist() for part in boxes] for _, boxes in native(env, 0)] == [
        [[1.0, 10.0], [], [0.3]],
        [[-1.0, 30.0], [], [0.3]],
    ]
    assert native(env, 1)[0][1][2] == 0.1
    assert native(env, 1)[1][1][2] == 0.1


@pytest.mark.parametrize(
    ("discrete", "parameters", "complaint"),
    [
        ([0, 0], [[0.0, 20.0, 0.2], [0.0, np.nan, 0.2]], r"environment 1 got discrete=0 \(allowed 0 to 2\), .*nan"),
        ([3, 0], [[0.0, 20.0, 0.2]] * 2, "environment 0 got discrete=3"),
        ([0.0, 1.0], [[0.0, 20.0, 0.2]] * 2, "has type float32, but must be integer"),
        ([0, 0], [[0.0, 20.0]] * 2, r"'parameters'\) has shape \[2, 2\], but must be \[2, 3\]"),
    ],
)
def test_an_invalid_action_is_refused_and_changes_nothing(discrete, parameters, complaint):
    env = make(2)
    env.reset()
    with pytest.raises(ValueError, match=complaint) as raised:
        step(env, discrete, parameters)
    assert "\n" not in str(raised.value)
    assert not native(env, 0) and not native(env, 1)


@pytest.mark.parametrize("action_format", ["tuple", "dict"])
def test_boats_move_through_gymnasium_as_in_their_own_environment(action_format):
    env = GymnasiumEnv(
        3,
        id="hpamdp/BoatDock-v0",
        kwargs={"controller": "congruent", "action_format": action_format, "motor_noise": 0.1},
        max_steps=25,
        parameter_dims=[1, 1, 1] if action_format == "dict" else None,
        observation_scaling="none",
    )
    seeds = torch.tensor([3, 14, 15])
    boats = [BoatDockEnv(controller="congruent", motor_noise=0.1, seed=int(seed)) for seed in seeds]
    seen = env.reset(TensorDict(seed=seeds, batch_size=[3]))
    assert torch.equal(seen["observation"], torch.cat([boat.reset()["observation"] for boat in boats]))
    generator = torch.Generator().manual_seed(0)
    episodes = 0
    for _ in range(90):
        key = torch.randint(3, (3,), generator=generator)
        seconds = 0.6 * torch.rand(3, 3, generator=generator) - 0.01
        after = step(env, key, seconds)
        others = torch.cat([step_one(boat, key[[i]], seconds[[i]]) for i, boat in enumerate(boats)])
        for name in ("observation", "reward", "done", "terminated", "truncated"):
            assert torch.equal(after[name], others[name]), name
        if after["done"].all():
            episodes += 1
            mask = [True, False, True]
            seen = reset_rows(env, after, mask)
            rows = [boat.reset() if mask[i] else others[[i]] for i, boat in enumerate(boats)]
            assert torch.equal(seen["observation"], torch.cat([row["observation"] for row in rows]))
    assert episodes > 2


def step_one(boat: BoatDockEnv, key: torch.Tensor, seconds: torch.Tensor) -> TensorDict:
    press = TensorDict(discrete=key, parameters=seconds, batch_size=[1])
    after = boat.step(TensorDict(action=press, batch_size=[1]))["next"]
    return after.select("observation", "reward", "done", "terminated", "truncated")


def test_a_finished_episode_stays_and_earns_nothing_until_it_is_reset():
    env = make(2, max_steps=3)
    env.envs[0].unwrapped.length = 2
    env.reset()
    for _ in range(2):
        last = step(env)
    assert last["terminated"].squeeze(-1).tolist() == [True, False]
    later = [step(env) for _ in range(3)]
    assert all(torch.equal(after["observation"][0], last["observation"][0]) for after in later)
    assert torch.stack([after["reward"] for after in later]).squeeze(-1).tolist() == [
        [0.0, 3.0],
        [0.0, 0.0],
        [0.0, 0.0],
    ]
    assert len(native(env, 0)) == 2 and len(native(env, 1)) == 3
    assert later[-1]["terminated"].squeeze(-1).tolist() == [True, False]
    assert later[-1]["truncated"].squeeze(-1).tolist() == [False, True]
    assert later[-1]["done"].all()
    seen = reset_rows(env, later[-1], [False, True])
    assert torch.equal(seen["observation"][0], last["observation"][0])
    assert seen["done"].squeeze(-1).tolist() == [True, False] and seen["observation"][1, 1] == 0.0


def test_returned_tensors_never_change_later():
    env = make(2)
    kept = [env.reset(), step(env)]
    copies = [td.clone() for td in kept]
    step(env)
    env.reset()
    assert all((one == other).all() for one, other in zip(kept, copies, strict=True))


def test_an_end_in_the_last_step_of_the_time_limit_is_no_truncation():
    env = make(kwargs={"length": 2}, max_steps=2)
    env.reset()
    step(env)
    after = step(env)
    assert after["terminated"].item() and not after["truncated"].item()


def test_a_partial_step_moves_only_its_rows():
    env = make(2)
    before = env.reset()
    after = env.step(action(env, [0, 0], [[0.0] * 3] * 2).set("_step", torch.tensor([[True], [False]])))["next"]
    assert torch.equal(after["observation"][1], before["observation"][1])
    assert after["reward"].squeeze(-1).tolist() == [1.0, 0.0]
    assert len(native(env, 0)) == 1 and not native(env, 1)


def test_a_seed_fixes_the_episodes_whatever_the_number_of_copies():
    def first_three(env: GymnasiumEnv, **given) -> torch.Tensor:
        return torch.stack([env.reset(**(given if number == 0 else {}))["observation"] for number in range(3)])

    one, other = make(2, seed=5), make(4, seed=5)
    seen = first_three(one)
    assert torch.equal(seen, first_three(other)[:, :2])
    assert len(set(seen[..., 0].flatten().tolist())) == 6
    assert not torch.equal(seen, first_three(one))
    one.set_seed(5)
    assert torch.equal(seen, first_three(one))
    one.set_seed(6)
    assert not torch.equal(seen, first_three(one))
    fixed = first_three(one, tensordict=one.fixed_episodes(5))
    assert torch.equal(
        fixed[:, 1:], first_three(make(1, first_env=1), tensordict=make(1, first_env=1).fixed_episodes(5))
    )
    assert not torch.equal(seen[0], fixed[0])
    assert torch.equal(fixed, first_three(make(2, seed=9), tensordict=one.fixed_episodes(5)))


def test_given_seeds_affect_only_the_copies_that_are_reset():
    env = make(2, seed=1)
    expected_row = make(2, seed=1).reset()["observation"][1]
    reset_rows(env, env.full_done_spec.zero().set("seed", torch.tensor([8, 9])), [True, False])
    assert torch.equal(env.reset()["observation"][1], expected_row)
    for wrong in (torch.tensor([1, -1]), torch.tensor([1.0, 2.0]), torch.ones(2, 1, dtype=torch.int64)):
        with pytest.raises(ValueError, match="seed must be integers of at least 0"):
            env.reset(TensorDict(seed=wrong, batch_size=[2]))


def test_the_time_limit_is_the_environments_own_or_the_one_given():
    assert GymnasiumEnv(id="toy_environments:Toy-v0").max_steps == 6
    assert GymnasiumEnv(entry_point="toy_environments:make_toy").max_steps == 6
    for limit in (3, 9):
        env = GymnasiumEnv(id="Toy-v0", max_steps=limit)
        assert env.max_steps == limit
        env.reset()
        assert [step(env)["truncated"].item() for _ in range(limit)] == [False] * (limit - 1) + [True]


def test_success_comes_from_the_infos():
    silent = make(2, kwargs={"length": 2})
    reporting = make(2, kwargs={"length": 2, "success": True})
    for env in (silent, reporting):
        env.reset()
        env.envs[1].unwrapped.length = 4
        for _ in range(2):
            last = step(env)
        assert last["success"].tolist() == [env is reporting, False]
    assert silent.results(last.clone().fill_("success", False)) == {}
    assert reporting.results(last)["success"].tolist() == [True, False]
    assert step(reporting)["success"].tolist() == [True, False]
    assert reporting.reset()["success"].tolist() == [False, False]
    assert set(GymnasiumEnv.result_keys) <= set(last.keys())
    # As reported to copies in another process: this one was never stepped.
    assert make(2).results(last)["success"].tolist() == [True, False]


@pytest.mark.parametrize("value", [True, 1, np.bool_(True), np.float32(1.0), np.array(1), np.array([True])])
def test_flags_may_be_of_any_kind_that_holds_true_and_false(value, monkeypatch):
    env = make()
    env.reset()
    returned = (STEP[0], np.float16([0.5]), value, False, {"success": value})
    monkeypatch.setattr(Toy, "step", lambda self, action: returned)
    after = step(env)
    assert after["success"].all() and after["terminated"].all() and after["reward"].item() == 0.5


def test_closing_closes_every_copy():
    env = make(3)
    env.close()
    assert not any(inner.unwrapped.is_open for inner in env.envs)


def mistake_in(**options) -> str:
    node = {"_target_": "hpamdp.env.gymnasium.environment.GymnasiumEnv", **options}
    with pytest.raises(ConfigError) as raised:
        component("env", "gymnasium", node).build(num_envs=2, device="cpu", seed=0)
    assert "\n" not in str(raised.value) and str(raised.value).count("GymnasiumEnv") == 1
    return str(raised.value)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({}, "set env.id=Name-v0 or env.entry_point=package.module:name; neither is set"),
        ({"id": "Toy-v0", "entry_point": TOY}, "both are set"),
        ({"id": "Nowhere-v0"}, "Nowhere-v0: Environment `Nowhere` doesn't exist"),
        ({"id": "Endless-v0"}, "Endless-v0: has no time limit of its own; set env.max_steps"),
        ({"entry_point": "toy_environments:Texting", "max_steps": 5}, "Texting: action space Tuple(Discrete(2), Text("),
        (
            {"id": "hpamdp/CatchPoint-v0", "kwargs": {"wide": 1}},
            "hpamdp/CatchPoint-v0: wide: no such setting of CatchPointOptions",
        ),
        ({"entry_point": "toy_environments:Nobody"}, "there is no class or function Nobody in toy_environments"),
        ({"entry_point": "builtins:object", "max_steps": 5}, "wrap an environment of gym with shimmy"),
    ],
)
def test_a_mistake_is_explained_in_one_line(options, complaint):
    assert complaint in mistake_in(**options)


STEP = (np.zeros(2), 0.5, False, False, {})


@pytest.mark.parametrize(
    ("returned", "complaint"),
    [
        (STEP[:3], "step returned 3 values, not observation, reward, terminated, truncated and info"),
        ((STEP[0], None, *STEP[2:]), "step returned None as reward, which must be a number"),
        ((*STEP[:4], {"is_success": float("nan")}), "step returned nan as info['is_success'], which must be True or"),
        ((*STEP[:4], None), "step returned None as info, which must be a dictionary"),
        ((np.zeros((2, 1)), *STEP[1:]), "gave an observation whose value has shape (2, 1), but its space has (2,)"),
    ],
)
def test_a_step_that_breaks_gymnasiums_contract_is_told_in_one_line(returned, complaint, monkeypatch):
    env = make(2)
    env.reset()
    monkeypatch.setattr(Toy, "step", lambda self, action: returned)
    with pytest.raises(ProblemError) as raised:
        step(env)
    assert "environment 0: " in str(raised.value) and complaint in str(raised.value)


def test_other_breaches_of_gymnasiums_contract_are_told_in_one_line(monkeypatch):
    env = make(2)
    monkeypatch.setattr(Toy, "reset", lambda self, seed=None, options=None: np.zeros(2))
    with pytest.raises(ProblemError, match="reset must return an observation and an info"):
        env.reset()
    monkeypatch.setattr(Toy, "reset", lambda self: (np.zeros(2), {}))
    with pytest.raises(ProblemError, match="reset must take seed and options: "):
        env.reset()
