"""Demands, plans by hand and refusals of traffic lights, without SUMO."""

from __future__ import annotations

from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import make_config

from hpamdp.env.traffic import lights
from hpamdp.env.traffic.demand import HELD_OUT, KINDS, NUM_DEMANDS, Demand, draw
from hpamdp.env.traffic.network import FOLDER, GREENS, NETWORKS, YELLOW, entries, lanes_of
from hpamdp.env.traffic.options import PHASES
from hpamdp.env.traffic.players import Webster
from hpamdp.env.traffic.simulation import observation_names

HOUR = 3600


@pytest.mark.parametrize("kind", KINDS)
def test_a_demand_is_a_function_of_its_number(kind):
    one, same, other = (draw(number, kind, "corridor", HOUR, 1.0) for number in (5, 5, 6))
    np.testing.assert_array_equal(one.flows, same.flows)
    assert (one.flows != other.flows).all() and (one.flows > 0.0).all()
    assert all((one.turns[edge] == same.turns[edge]).all() for edge in one.turns)
    np.testing.assert_allclose([turn.sum() for turn in one.turns.values()], 1.0)


def test_light_demand_is_constant_rush_hour_has_a_peak_and_shifting_demand_changes_its_busy_axis():
    for number in range(20):
        light, rush, shifting = (draw(number, kind, "crossing", HOUR, 1.0).flows for kind in KINDS)
        assert (light == light[0]).all()
        peak = rush.sum(1).argmax()
        assert 0 < peak < len(rush) - 1 and rush.sum(1).max() > 1.5 * rush.sum(1)[[0, -1]].max()
        north_south = shifting[:, [0, 2]].sum(1) > shifting[:, [1, 3]].sum(1)
        assert north_south[0] != north_south[-1]
    assert (draw(1, "rush", "crossing", HOUR, 2.0).flows == 2.0 * draw(1, "rush", "crossing", HOUR, 1.0).flows).all()


class Recorder:
    """Stands for the simulation, and notes the numbers of the demands."""

    numbers: ClassVar[list[int]] = []

    def __init__(self, task):
        pass

    def begin(self, number):
        self.numbers.append(number)
        return lights.Seen(np.zeros(29, np.float32), 0.0, 0, False, {}, None)

    def act(self, phase, green):
        return lights.Seen(np.zeros(29, np.float32), 0.0, 0, True, dict.fromkeys(("delay", "queue"), 0.0), None)

    def close(self):
        pass


def test_training_and_evaluation_never_have_the_same_demand(monkeypatch):
    monkeypatch.setattr(lights, "SimulationProcess", Recorder)
    monkeypatch.setattr(lights, "network_file", lambda network: "")
    monkeypatch.setattr(Recorder, "numbers", [])
    cls = make_config(["env=traffic"]).env.cls
    for seed in (0, 10, 2**31 + 5):
        env = cls(50, seed=seed)
        for _ in range(3):  # the first episodes are seeded, the later ones are not
            env.reset()
        env.set_seed(seed + 1)
        env.reset()
    training = set(Recorder.numbers)
    assert len(training) == 3 * 200 and max(training) < HELD_OUT
    monkeypatch.setattr(Recorder, "numbers", [])
    for seed in (0, 10, 7, 2**31 + 5):
        env.seed_evaluation(seed)
        env.reset(env.fixed_episodes(seed))
    assert len(set(Recorder.numbers)) == 200
    assert all(HELD_OUT <= number < NUM_DEMANDS for number in Recorder.numbers)


def test_learners_can_start_with_greens_of_fifteen_seconds(monkeypatch):
    monkeypatch.setattr(lights, "network_file", lambda network: "")
    env = make_config(["env=traffic"]).env.cls(1, network="corridor")
    weights, bias = env.initial_parameters()
    assert weights.shape == (4, 93) and (weights == 0.0).all()
    low, high = (env.full_action_spec["action", "parameters"].space.low[0], 60.0)
    np.testing.assert_allclose(low + (bias + 1.0) / 2.0 * (high - low), 15.0)


def test_a_number_that_no_demand_has_is_refused(monkeypatch):
    monkeypatch.setattr(lights, "SimulationProcess", Recorder)
    monkeypatch.setattr(lights, "network_file", lambda network: "")
    with pytest.raises(ValueError, match=f"seed={NUM_DEMANDS}, but demands have numbers from 0 to {NUM_DEMANDS - 1}"):
        lights.TrafficLights().reset(seed=NUM_DEMANDS)


@pytest.mark.parametrize("network", NETWORKS)
def test_as_many_vehicles_leave_a_network_as_enter_it(network):
    demand = draw(3, "shifting", network, HOUR, 1.0)
    flows = demand.mean_flows()
    inward = {edge for signal in NETWORKS[network] for edge in signal.inward()}
    assert flows.keys() == inward
    leaving = sum(
        flow
        for signal in NETWORKS[network]
        for arm, edge in enumerate(signal.inward())
        for to, flow in zip(signal.turns(arm), flows[edge], strict=True)
        if to not in inward
    )
    assert leaving == pytest.approx(demand.flows.mean(0).sum())


def test_websters_plan_is_that_of_his_formula():
    turns = {f"{arm}_to_A": np.array([0.2, 0.7, 0.1]) for arm in NETWORKS["crossing"][0].arms}
    flows = np.array([[900.0, 450.0, 450.0, 225.0]])
    plan = Webster(Demand("crossing", np.array([HOUR]), flows, turns))
    # Flow ratios of a lane at 1,800 vehicles an hour: 0.8 * 900 / 2 and 0.2 * 900, then half of both.
    ratios = np.array([0.2, 0.1, 0.1, 0.05])
    cycle = (1.5 * 16.0 + 5.0) / (1.0 - ratios.sum())
    (greens,) = plan.greens
    assert sum(greens) + 4 * YELLOW == round(cycle)
    np.testing.assert_allclose(greens, ratios / ratios.sum() * (cycle - 4 * YELLOW), atol=1.0)


def test_all_crossings_of_the_corridor_have_one_cycle_even_if_demand_exceeds_what_they_discharge():
    for traffic in (0.1, 1.0, 3.0):
        plan = Webster(draw(0, "rush", "corridor", HOUR, traffic))
        (cycle,) = {sum(greens) + 4 * YELLOW for greens in plan.greens}
        assert 40 <= cycle <= 120 and min(min(greens) for greens in plan.greens) >= 5


def test_each_lane_has_its_green_in_one_phase_and_each_link_too():
    lanes = [lane for phase in range(len(PHASES)) for lane in lanes_of(phase)]
    assert sorted(lanes) == [(arm, lane) for arm in range(4) for lane in range(3)]
    assert all(sum(green[link] == "G" for green in GREENS) == 1 for link in range(16))
    for phase, green in enumerate(GREENS):
        served = {(link // 4, (0, 0, 1, 2)[link % 4]) for link in range(16) if green[link] == "G"}
        assert served == set(lanes_of(phase))


@pytest.mark.parametrize("network", NETWORKS)
def test_the_files_have_the_roads_turns_and_programs_that_the_code_names(network):
    parts = {part: ElementTree.parse(FOLDER / f"{network}.{part}.xml").getroot() for part in ("edg", "con", "tll")}
    edges = {edge for signal in NETWORKS[network] for edge in (*signal.inward(), *signal.outward())}
    assert {edge.get("id") for edge in parts["edg"]} == edges and set(entries(network)) <= edges
    turns = {(each.get("from"), each.get("to")) for each in parts["con"]}
    named = [(signal, arm) for signal in NETWORKS[network] for arm in range(4)]
    assert turns == {(signal.inward()[arm], to) for signal, arm in named for to in signal.turns(arm)}
    for program in parts["tll"]:
        assert [phase.get("state") for phase in program][::2] == list(GREENS)
        assert [phase.get("state") for phase in program][1::2] == [green.replace("G", "y") for green in GREENS]


def test_an_observation_has_a_name_for_each_entry():
    assert len(observation_names("crossing")) == 29 and len(observation_names("corridor")) == 93
    assert all(len({*observation_names(network)}) == len(observation_names(network)) for network in NETWORKS)
