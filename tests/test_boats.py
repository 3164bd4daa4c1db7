"""Boats of any number, with directions of their own, and boats that may be changed inside an episode."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from conftest import compose_config
from tensor_rules import boat_rules
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.config.compose import read
from hpamdp.env import counter_rng
from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.gymnasium_adapter import BoatDock, BoatDockVector
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import CONTROLLER_DEGREES, NOT_CHOSEN, BoatState
from hpamdp.env.state_columns import where
from hpamdp.run.assemble import assemble

THREE = ["congruent", "incongruent1", "incongruent2"]
SIDEWAYS = {"sideways": [0.0, 90.0, 180.0]}


def made(boats=None, switch_cost=None, controllers=None) -> BoatDockOptions:
    controllers = CONTROLLER_DEGREES if controllers is None else controllers
    return BoatDockOptions(boats=boats, switch_cost=switch_cost, controllers=controllers)


def layouts(num) -> tuple[harbour.Layout, torch.Tensor]:
    return harbour.fixed_layouts(num, seed=5), torch.ones(num, dtype=torch.int32)


def press(env: BoatDockEnv, key: list[int], duration: list[float], option: list[int]) -> TensorDictBase:
    td = TensorDict({keys.OPTION: torch.tensor(option)}, batch_size=[env.num_envs])
    td[keys.DISCRETE] = torch.tensor(key)
    td[keys.PARAMETERS] = torch.tensor(duration).unsqueeze(-1).expand(-1, 3).clone()
    return env.step(td)["next"]


def test_peoples_two_boats_by_name_play_as_they_do_without():
    plain, named = BoatDockEnv(300, seed=1), BoatDockEnv(300, seed=1, boats=["incongruent1", "congruent"])
    one, other = plain.reset(), named.reset()
    for _ in range(5):
        action = plain.rand_action(one.clone()).select(keys.OPTION, keys.ACTION)
        action[keys.PARAMETERS] *= 0.4
        one_step, one = plain.step_and_maybe_reset(one.update(action))
        other_step, other = named.step_and_maybe_reset(other.update(action))
        assert (one_step["next"] == other_step["next"]).all()


def test_a_boat_of_the_users_goes_where_its_degrees_say():
    env = BoatDockEnv(3, boats=["congruent", "sideways"], controllers=SIDEWAYS)
    goal = torch.tensor([[640.0, 420.0]] * 3)
    env.reset(TensorDict({"start": torch.tensor([[640.0, 512.0]] * 3), "goal": goal}, batch_size=[3]))
    press(env, [0, 1, 2], [0.5] * 3, [1] * 3)
    length = physics.total_distance(torch.tensor(0.5)).item()
    expected = torch.tensor([[length, 0.0], [0.0, length], [-length, 0.0]])
    torch.testing.assert_close(env.position, expected, atol=1e-4, rtol=0.0)
    assert env.option_names == ("congruent", "sideways")


def test_random_controllers_are_all_of_the_boats_equally_often():
    env = BoatDockEnv(6000, boats=[*THREE, "sideways"], controllers=SIDEWAYS, controller="random")
    env.reset()
    shares = torch.bincount(env.state.controller.long(), minlength=4) / 6000
    torch.testing.assert_close(shares, torch.full((4,), 0.25), atol=0.03, rtol=0.0)


@pytest.mark.parametrize("boats", [None, THREE])
def test_a_change_of_boats_costs_its_fuel_once_and_turns_the_keys(boats):
    env = BoatDockEnv(1, boats=boats, switch_cost=0.25)
    env.reset()
    fuel = []
    for option in (1, 1, 0, 0):
        after = press(env, [1], [0.1], [option])
        fuel.append(after["fuel"].item() * physics.TANK)
        assert env.state.controller.item() == option
    spent = np.diff([physics.TANK, *fuel])
    np.testing.assert_allclose(spent, [-0.1, -0.1, -0.35, -0.1], atol=1e-5)


def test_a_change_that_the_tank_cannot_pay_ends_the_episode():
    env = BoatDockEnv(1, switch_cost=1.0)
    env.reset()
    env.state = env.state._replace(fuel=torch.tensor([0.9]), controller=torch.tensor([0], dtype=torch.int32))
    after = press(env, [0], [0.5], [1])
    assert after[keys.OUTCOME].item() == physics.OUT_OF_FUEL and after["fuel"].item() == 0.0


def test_the_planner_of_any_boats_gives_peoples_boats_their_scores():
    layout, keymap = layouts(60)
    expected = planner.best_plans(layout, keymap).score
    found = planner.best_scores(made(["incongruent1", "congruent"]), layout, keymap)
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0.0)


def test_changes_never_make_a_layout_worse_and_cheaper_ones_are_worth_more():
    layout, keymap = layouts(20)
    held = planner.best_plans(layout, keymap).score.amax(1)
    free, cheap, dear = (planner.best_scores(made(None, cost), layout, keymap).amax(1) for cost in (0.0, 0.15, 6.0))
    assert (free >= cheap - 1e-3).all() and (cheap >= held - 1e-3).all()
    torch.testing.assert_close(dear, held, atol=1e-3, rtol=0.0)
    assert free.mean() > cheap.mean() + 0.01 > held.mean() + 0.01


def follow(env: BoatDockEnv, option: int | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores and outcomes of the oracle's presses, which begin with an option or with the best one."""
    td = env.reset()
    row = torch.arange(env.num_envs)
    for number in range(planner.MAX_PRESSES + 1):
        chosen = td["oracle", "option"]
        if option is not None and (number == 0 or env.options.switch_cost is None):
            chosen = torch.full_like(chosen, option)
        td[keys.OPTION] = chosen
        td[keys.DISCRETE] = td["oracle", "discrete"][row, chosen]
        td[keys.PARAMETERS] = td["oracle", "parameters"][row, chosen].unsqueeze(-1).expand(-1, 3).contiguous()
        td = env.step(td)["next"]
    return harbour.score(td[keys.OUTCOME], td["fuel"].squeeze(-1)), td[keys.OUTCOME]


@pytest.mark.parametrize(
    "settings",
    [
        {"boats": THREE},
        {"switch_cost": 0.1, "keymap": "random"},
        {"boats": ["incongruent2", "sideways", "congruent"], "controllers": SIDEWAYS, "switch_cost": 0.05},
    ],
    ids=str,
)
def test_the_oracle_reaches_the_score_of_its_plans(settings):
    env = BoatDockEnv(4, oracle=True, seed=2, **settings)
    for option in (None, 0):
        env.set_seed(2)
        env.reset()
        optimum = env.describe()["optimum"]
        env.set_seed(2)
        planned = optimum.amax(1) if option is None else optimum[:, option]
        score, outcome = follow(env, option)
        solved = planned > -1.0
        assert (outcome[solved] == physics.SUCCESS).all()
        torch.testing.assert_close(score[solved], planned[solved], atol=2e-3, rtol=0.0)


@pytest.mark.parametrize("presses", [0, 1])
def test_boats_that_are_put_elsewhere_have_the_plans_of_that_place(presses):
    env, other = (BoatDockEnv(16, controller="congruent", oracle=True, seed=seed) for seed in (2, 3))
    env.reset()
    td = other.reset()
    for _ in range(presses):
        td[keys.DISCRETE], td[keys.PARAMETERS] = torch.zeros(16, dtype=torch.long), torch.full((16, 3), 0.1)
        td = other.step(td)["next"]
    env.state = other.state
    planned = env.read()["oracle"]
    first = planner.plans_of_options(env.options, env.state)
    assert torch.equal(planned["discrete"], first.keys[..., 0])
    assert torch.equal(planned["parameters"], first.durations[..., 0])
    if presses == 0:
        assert (planned == td["oracle"]).all()
    restored = BoatDockEnv(16, controller="congruent", oracle=True)
    restored.set_env_state(env.env_state())
    assert (restored.read()["oracle"] == planned).all()


CHANGED = made(["congruent", "incongruent1", "sideways"], 0.15, SIDEWAYS)
FREELY_CHANGED = made(["congruent", "incongruent1", "sideways"], 0.0, SIDEWAYS)


@pytest.mark.parametrize("rules", [CHANGED, pytest.param(FREELY_CHANGED, marks=pytest.mark.slow)])
def test_an_evolutionary_search_over_presses_and_boats_never_beats_the_planner(rules):
    num, samples, elite, children, num_presses = 25, 4000, 30, 8, 3
    layout = harbour.fixed_layouts(num, seed=3)
    generator = torch.Generator().manual_seed(num_presses)
    best = planner.best_scores(rules, layout, torch.ones(num, dtype=torch.int32)).amax(1)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    def score_of(boats, pressed, durations):
        shape = durations.shape[:-1]
        place = [column.reshape(num, *[1] * (len(shape) - 1)).expand(shape) for column in layout]
        zeros = torch.zeros(shape, dtype=torch.int32)
        state = BoatState(
            *place, place[0], place[1], zeros.float(), zeros.float(), zeros + physics.TANK, zeros + NOT_CHOSEN,
            zeros + 1, zeros, zeros, zeros
        )  # fmt: skip
        flat = BoatState(*(column.reshape(-1) for column in state))
        row = torch.zeros(flat.x.shape, dtype=torch.int32)
        rng = counter_rng.rng_key(counter_rng.seed_tensor(0), counter_rng.NOISE, row, row)
        for number in range(num_presses):
            duration = durations[..., number].reshape(-1)
            option, key = boats[..., number].reshape(-1), pressed[..., number].reshape(-1)
            after, _ = boat_rules.act(flat, option, key, duration, rng, rules)
            flat = where(flat.outcome == physics.SAILING, after, flat)
        return harbour.score(flat.outcome, flat.fuel / physics.TANK).reshape(shape)

    boats, pressed = (torch.randint(3, (num, samples, num_presses), generator=generator) for _ in range(2))
    durations = physics.press_for(rand(num, samples, num_presses) * rand(num, samples, 1) * 230.0)
    score, kept = score_of(boats, pressed, durations).topk(elite, dim=1)
    boats, pressed, durations = (field.take_along_dim(kept[..., None], 1) for field in (boats, pressed, durations))
    for width in torch.logspace(-1.0, -4.0, 25).tolist():
        noise = torch.randn(num, elite, children, num_presses, generator=generator)
        mutants = (durations[:, :, None] + width * noise).clamp(0.0, physics.MAX_DURATION)
        found = score_of(*(field[:, :, None].expand(mutants.shape) for field in (boats, pressed)), mutants)
        best_found, number = found.max(dim=2)
        mutants = mutants.take_along_dim(number[..., None, None], 2).squeeze(2)
        durations = torch.where((best_found > score)[..., None], mutants, durations)
        score = torch.maximum(score, best_found)
    excess = score.amax(1) - best
    assert excess.max() < 2e-3
    assert excess.median() > -0.05  # a fair opponent


def test_gymnasium_has_the_boats_and_their_changes():
    settings = {"boats": [*THREE, "sideways"], "controllers": SIDEWAYS, "switch_cost": 0.5}
    one = gymnasium.make("hpamdp/BoatDock-v0", render_mode="rgb_array", **settings)
    observation, _ = one.reset(seed=0)
    assert one.action_space["option"].n == 4 and one.observation_space.contains(observation)
    for option in (3, 1):
        action = {"option": option, "key": 0, "duration": np.full(3, 0.1, np.float32)}
        observation, _, _, _, info = one.step(action)
        assert info["controller"] == option and one.observation_space.contains(observation)
    assert info["fuel"] == pytest.approx(1.0 - 0.7 / 6.0)
    assert one.render().shape == (480, 480, 3)
    many = BoatDockVector(3, **settings)
    many.reset(seed=0, options={"start": [[600, 512]] * 3, "goal": [[700, 512]] * 3})
    _, _, _, _, infos = many.step({"option": [0, 2, 3], "key": [0] * 3, "duration": np.full((3, 3), 0.1)})
    assert infos["controller"].tolist() == [0, 2, 3]
    with pytest.raises(ValueError, match="no controller upwards"):
        BoatDock(boats=["congruent", "upwards"])


@pytest.mark.parametrize("high", ["actor", "option_critic"])
def test_selectors_that_end_options_train_with_changes_of_boats(high):
    learned = high == "option_critic"
    ends = ["agent.termination=learned"] if learned else ["agent.termination=steps", "agent.option_length=1"]
    words = [f"high={high}", "low=hppo", "env.switch_cost=0.2", "num_envs=4", "steps_per_batch=4", *ends]
    config = read(compose_config([*words, "eval.layouts=4", "low.minibatch_size=16"]))
    parts = assemble(config)
    means = parts.evaluation.measure(parts.evaluation.run(parts.agent.policy))
    assert (
        means["option_changes"] <= means["steps"] - 1.0
        and means["ceiling"] >= means["score"]
        and "human_normalised" in means
    )


def test_other_boats_are_not_compared_with_people():
    env = BoatDockEnv(20, boats=THREE)
    env.reset()
    played = {
        "outcome": np.ones(20, dtype=int),
        "score": np.full(20, 3.0),
        "optimum": env.describe()["optimum"].numpy(),
        "option": np.arange(20) % 3,
    }
    means = env.measure(played)
    assert "human_normalised" not in means and set(env.references(means)) == {"ceiling"}
    assert sum(means[f"option_{name}"] for name in THREE) == pytest.approx(1.0)
    best = played["optimum"].argmax(1)
    assert env.measure({**played, "option": best})["oracle_agreement"] == 1.0
    equally_good = np.where(best == 1, 2, best)
    assert env.measure({**played, "option": equally_good})["oracle_agreement"] == 1.0


def test_the_ceiling_succeeds_where_a_plan_docks_and_nowhere_else():
    sideways = BoatDockEnv(50, boats=["flat"], controllers={"flat": [0.0, 180.0, 0.0]}, controller="flat")
    sideways.reset()
    known = {name: value.numpy() for name, value in sideways.describe().items()}
    means = sideways.measure({"outcome": np.ones(50, dtype=int), "score": np.full(50, 3.0), **known})
    docks = (known["optimum"][:, 0] > -1.0).mean()
    assert 0.0 < docks < 1.0 and sideways.references(means)["ceiling"]["success"] == pytest.approx(docks)


def test_the_maps_of_other_boats_are_those_that_their_directions_share():
    assert len(BoatDockEnv(1, boats=THREE).symmetries) == 6
    assert len(BoatDockEnv(1, boats=["congruent", "incongruent2"]).symmetries) == 12
    assert len(BoatDockEnv(1, boats=["congruent", "sideways"], controllers=SIDEWAYS).symmetries) == 2


def test_the_changes_of_boats_in_an_evaluation_are_counted():
    words = ["high=uniform", "low=random", "env.switch_cost=0.2", "agent.termination=steps", "agent.option_length=1"]
    parts = assemble(read(compose_config([*words, "num_envs=4", "eval.layouts=50"])))
    played = parts.evaluation.run(parts.agent.policy)
    assert (played["option_changes"][played["steps"] == 1] == 0).all()
    share = played["option_changes"].sum() / (played["steps"] - 1).sum()
    assert share == pytest.approx(0.5, abs=0.1)
