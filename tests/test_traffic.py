"""Traffic lights in SUMO: signals, rewards, results and hand-written players."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.children import STOP_SIGNALS
from hpamdp.env.errors import ProblemError
from hpamdp.env.registration import register
from hpamdp.env.traffic import network
from hpamdp.env.traffic.environment import TrafficEnv
from hpamdp.env.traffic.lights import TrafficLights
from hpamdp.env.traffic.network import ARMS, GREENS, MAX_GREEN, MIN_GREEN, network_file, run_tool
from hpamdp.env.traffic.options import PHASES, PLAYERS
from hpamdp.env.traffic.simulation import Simulation, Task
from hpamdp.specs import PAMDPSpecs

if importlib.util.find_spec("libsumo") is None:
    pytest.skip("needs hpamdp[traffic]", allow_module_level=True)

register()


@pytest.fixture
def make():
    made = []

    def make(cls=TrafficEnv, *args, **settings):
        made.append(cls(*args, **{"minutes": 4, **settings}))
        return made[-1]

    yield make
    for env in made:
        env.close()


def simulation(folder, name="crossing", reward="queue", minutes=4):
    return Simulation(Task(name, "rush", str(network_file(name)), 60 * minutes, 1.0, reward), folder)


def action(phase, green=10.0):
    return phase, tuple(np.array([green], np.float32) for _ in PHASES)


def test_its_actions_are_phases_with_a_green_and_strategies_without(make):
    specs = PAMDPSpecs.from_env(make())
    assert specs.parameter_dims == (1, 1, 1, 1)
    assert specs.parameter_low == (5.0,) * 4 and specs.parameter_high == (60.0,) * 4
    assert PAMDPSpecs.from_env(make(strategies=True)).parameter_dims == (1, 1, 1, 1, 0, 0, 0, 0)
    assert make(whole_seconds=True).integer_parameters == (True,) * 4


@pytest.mark.parametrize("name", ["crossing", "corridor"])
def test_all_tensors_are_as_the_specs_say(make, name):
    check_env_specs(make(TrafficEnv, 1, network=name), return_contiguous=True)


def lights_over_time(simulation, decisions):
    """Return the state of the first signal in each second, and the numbers of seconds of the decisions."""
    states, step = [], simulation._step

    def recorded():
        step()
        states.append(simulation._sumo.trafficlight.getRedYellowGreenState("A"))

    simulation._step = recorded
    ends = []
    for phase, green in decisions:
        simulation.act(phase, green)
        ends.append(len(states))
    return states, ends


def test_greens_are_clipped_and_unknown_actions_refused(make):
    env = make(TrafficLights)
    env.reset(seed=1)
    for green, seconds in ((-3.0, MIN_GREEN), (1e6, MAX_GREEN)):
        env.step(action(0, green))
        assert env.last_seconds() == seconds
    for wrong, line in ((action(0, np.nan), "action 0 are .nan., but must be finite"), (action(-1), "discrete=-1")):
        with pytest.raises(ValueError, match=line):
            env.step(wrong)


def test_no_step_is_taken_before_an_episode_begins_or_after_it_ended(make):
    env = make(TrafficLights, minutes=1)
    for call in (lambda: env.step(action(0)), env.last_seconds, lambda: env.play("longest_queue")):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    env.reset(seed=1)
    while not env.step(action(0, MAX_GREEN))[3]:
        pass
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(action(0))


def test_three_seconds_of_yellow_stand_between_different_phases_and_none_between_equal_ones(tmp_path):
    run = simulation(tmp_path)
    run.begin(0)
    states, ends = lights_over_time(run, [(0, 7.0), (0, 5.4), (2, 6.0), (1, 5.0)])
    run._stop()
    yellow = [green.replace("G", "y") for green in GREENS]
    assert states[:12] == [GREENS[0]] * 12
    assert states[12:21] == [yellow[0]] * 3 + [GREENS[2]] * 6
    assert states[21:] == [yellow[2]] * 3 + [GREENS[1]] * 5
    assert ends == [7, 12, 21, 29]


@pytest.mark.parametrize("name", ["crossing", "corridor"])
def test_the_actuated_player_is_sumos_own_program(tmp_path, name):
    run = simulation(tmp_path, name, minutes=10)
    run.begin(4)
    given = ["--net-file", str(network_file(name)), "--route-files", str(tmp_path / "vehicles.rou.xml")]
    given += ["--seed", "4", "--time-to-teleport", "-1", "--end", "600", "--no-step-log", "true"]
    given += ["--tripinfo-output", str(tmp_path / "own.xml"), "--tripinfo-output.write-unfinished", "true"]
    run_tool("sumo", *given, "--tripinfo-output.write-undeparted", "true")
    results = run.play("actuated")
    own = ElementTree.parse(tmp_path / "own.xml").getroot()
    assert results["delay"] == pytest.approx(
        np.mean([float(trip.get("timeLoss")) + float(trip.get("departDelay")) for trip in own])
    )
    assert results["throughput"] == 6.0 * sum(float(trip.get("arrival")) >= 0.0 for trip in own)


def test_an_agent_that_always_takes_a_strategy_has_the_results_of_that_player(make):
    for name in ("crossing", "corridor"):
        env = make(TrafficLights, network=name, strategies=True, minutes=2)
        for number, player in enumerate(PLAYERS):
            env.reset(seed=9)
            is_over = False
            while not is_over:
                _, parameters = env.action_space.sample()
                *_, is_over, info = env.step((len(PHASES) + number, parameters))
            assert info == env.play(player)


def test_after_a_decision_of_the_agent_sumos_program_takes_over_with_a_whole_yellow(tmp_path):
    run = simulation(tmp_path)
    run.begin(0)
    states, _ = lights_over_time(run, [(2, 6.0)])
    run.follow("actuated")
    run.act(2, 5.0)
    run._stop()
    runs = [(state, 1) for state in states[:1]]
    for state in states[1:]:
        runs = [*runs[:-1], (state, runs[-1][1] + 1)] if state == runs[-1][0] else [*runs, (state, 1)]
    shown, lengths = zip(*runs, strict=True)
    yellow = [green.replace("G", "y") for green in GREENS]
    assert shown == (yellow[0], GREENS[2], yellow[2], GREENS[3], yellow[3], GREENS[2])
    assert lengths[:3] == (3, 6, 3) and lengths[3] >= 5 and lengths[4:] == (3, 5)


def test_with_queue_the_return_is_minus_the_vehicle_hours_waited(make):
    env = make(TrafficLights)
    env.reset(seed=1)
    total, is_over = 0.0, False
    while not is_over:
        _, reward, _, is_over, info = env.step(action(int(total * 1e6) % 4))
        total += reward
    assert total == pytest.approx(-info["queue"] * 4 / 60)
    assert info["delay"] > 0.0 and info["stops"] > 0.0 and info["throughput"] > 0.0


def test_the_duration_of_a_step_is_the_time_until_the_next_decision(make):
    env = make(TrafficEnv, 1)
    td = env.reset()
    assert not td[keys.DURATION].any()
    durations = []
    for phase, green in ((0, 10.0), (0, 12.4), (2, 30.0), (1, 60.0), (0, 60.0), (1, 60.0)):
        td.set(keys.DISCRETE, torch.tensor([phase]))
        td.set(keys.PARAMETERS, torch.full((1, 4), green, dtype=torch.float32))
        td = env.step(td)["next"]
        durations.append(round(10.0 * td[keys.DURATION].item()))
    # 3 s of yellow between different phases; the last step ends with the episode of 4 minutes.
    assert durations == [10, 12, 33, 63, 63, 59]


def test_with_waiting_the_return_is_minus_the_time_that_standing_vehicles_have_waited_at_the_end(tmp_path):
    run = simulation(tmp_path, reward="waiting")
    run.begin(1)
    total, waited = 0.0, []
    measure = run._measure
    run._measure = lambda: waited.append(measure()) or waited[-1]
    seen = run.act(0, 20.0)
    while not seen.is_over:
        total += seen.reward
        seen = run.act(0, 20.0)
    assert total + seen.reward == pytest.approx(-waited[-1] / 3600.0) and waited[-1] > 0.0


def test_the_same_demand_has_the_same_vehicles_whatever_the_agent_does(make):
    env = make(TrafficLights)
    seen = [env.reset(seed=5)[0]]
    first = (env._simulation._folder.name, "vehicles.rou.xml")
    vehicles = ElementTree.parse(os.path.join(*first)).getroot()
    departs = [(each.get("id"), each.get("depart")) for each in vehicles]
    env.step(action(3, 60.0))
    seen.append(env.reset(seed=5)[0])
    again = ElementTree.parse(os.path.join(*first)).getroot()
    assert departs == [(each.get("id"), each.get("depart")) for each in again] and len(departs) > 50
    np.testing.assert_array_equal(*seen)


def test_in_the_corridor_the_agent_sets_the_signal_whose_green_has_ended(make):
    env = make(TrafficLights, network="corridor")
    seen, _ = env.reset(seed=0)
    due = []
    for green in (30.0, 10.0, 20.0, 40.0):
        due.append(seen[[30, 61, 92]].argmax())
        assert seen[[30, 61, 92]].sum() == 1.0
        seen, *_ = env.step(action(0, green))
    assert due == [0, 1, 2, 1]
    assert seen[[30, 61, 92]].argmax() == 2
    # Seconds left, in minutes: 20 s have passed.
    np.testing.assert_allclose(seen[[29, 60, 91]], [10 / 60, 30 / 60, 0.0], atol=1e-6)


def test_the_closing_table_shows_the_players_on_the_demands_of_the_evaluation(make):
    env = make(TrafficEnv, 2)
    env.reset(env.fixed_episodes(3))
    while not env._is_over.all():
        discrete = torch.zeros(2, dtype=torch.int64)
        parameters = torch.full((2, 4), 60.0, dtype=torch.float32)
        env.step(TensorDict({keys.DISCRETE: discrete, keys.PARAMETERS: parameters}, batch_size=[2]))
    played = env.played()
    assert (played["score"] == -played["delay"]).all() and len(set(played["delay"].tolist())) == 2
    measured = env.measure({name: column.numpy() for name, column in played.items()})
    figures = env.references(measured)
    assert set(figures) == set(PLAYERS) and figures["actuated"]["delay"] < measured["delay"]
    alone = make(TrafficLights)
    delays = []
    for number in env.fixed_episodes(3)["seed"].tolist():
        alone.reset(seed=number)
        delays.append(alone.play("webster")["delay"])
    assert figures["webster"]["delay"] == pytest.approx(np.mean(delays))


def test_a_crossing_that_is_turned_has_the_same_phases_for_the_turned_lanes(make):
    """Of each lane a number of vehicles, and the phase that serves it: also after a turn."""
    env = make(strategies=True)
    maps, names = env.symmetries, env.observation_names
    assert len(maps) == 4 and make(network="corridor").symmetries is None
    number = torch.arange(4)
    for phase in range(len(PHASES)):
        for arm, lane in network.lanes_of(phase):
            seen = torch.zeros(len(names), dtype=torch.float32)
            seen[[names.index(f"queue_{ARMS[arm]}_{lane}"), names.index(f"phase_{phase}")]] = 1.0
            turned = maps.map_observation(number, seen.repeat(4, 1))
            chosen, _ = maps.map_action(
                number, torch.zeros_like(number), torch.full((4,), phase), torch.zeros(4, 4, dtype=torch.float32)
            )
            for turn in range(4):
                to = [names[entry] for entry in turned[turn].nonzero().flatten().tolist()]
                assert to == [f"queue_{ARMS[(arm + turn) % 4]}_{lane}", f"phase_{int(chosen[turn])}"]
                assert ((arm + turn) % 4, lane) in network.lanes_of(int(chosen[turn]))


def test_the_initial_green_of_a_phase_grows_with_the_vehicles_that_it_serves(make):
    weight, bias = make().initial_parameters()
    names = make().observation_names
    assert torch.allclose(27.5 * (bias + 1.0) + 5.0, torch.tensor(3.0))
    for phase in range(len(PHASES)):
        served = {names.index(f"queue_{ARMS[arm]}_{lane}") for arm, lane in network.lanes_of(phase)}
        assert set(weight[phase].nonzero().flatten().tolist()) == served
    # Ten vehicles on a lane for left, and ten on one for through.
    assert torch.allclose(27.5 * weight[1, names.index("queue_north_2")] * 10.0 / 20.0, torch.tensor(12.0))
    assert torch.allclose(27.5 * weight[0, names.index("queue_north_1")] * 10.0 / 20.0, torch.tensor(7.0))
    weight, bias = make(network="corridor").initial_parameters()
    assert not weight.any() and torch.allclose(27.5 * (bias + 1.0) + 5.0, torch.tensor(15.0))


def test_strategies_are_options_for_the_high_level(make):
    env = make(TrafficEnv, 1, strategies=True)
    env.group_actions(env.default_options)
    assert env.option_names == (*PLAYERS, "learned")
    assert [sum(row) for row in env.option_actions] == [1, 1, 1, 1, 4]
    assert not make().default_options


def test_a_sumo_that_dies_is_told_in_one_line(make):
    env = make()
    env.reset()
    os.kill(env.envs[0].unwrapped._simulation._process.pid, signal.SIGKILL)
    with pytest.raises(ProblemError, match=r"the process of SUMO died \(signal 9, SIGKILL\)$") as raised:
        env.reset()
    assert "\n" not in str(raised.value)


def test_the_process_of_sumo_ends_with_its_files_at_once_on_close_and_by_no_signal_of_the_run():
    env = TrafficLights(minutes=1)
    env.reset(seed=0)
    process, folder = env._simulation._process, env._simulation._folder.name
    for number in STOP_SIGNALS:  # a cluster may send them to all processes of a run
        os.kill(process.pid, number)
    env.step(action(0))
    assert process.poll() is None and os.path.isdir(folder)
    env.close()
    assert process.poll() == -signal.SIGKILL and not os.path.exists(folder)


def test_the_files_of_a_run_that_was_killed_are_removed_by_its_simulation():
    program = """
import os, signal
from hpamdp.env.traffic.lights import TrafficLights
env = TrafficLights(minutes=1)
env.reset(seed=0)
print(env._simulation._folder.name, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=False)
    folder = ended.stdout.strip()
    assert ended.returncode == -signal.SIGKILL and "hpamdp-traffic-" in folder
    until = time.monotonic() + 30.0
    while os.path.exists(folder) and time.monotonic() < until:
        time.sleep(0.05)
    assert not os.path.exists(folder)


def test_a_simulation_removes_no_folder_but_its_own(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    run, simulation = os.pipe()
    os.close(simulation)  # the run is gone
    program = f"from {Simulation.__module__} import serve; serve()"
    subprocess.run([sys.executable, "-c", program, str(run)], cwd=tmp_path, pass_fds=[run], check=True)
    os.close(run)
    assert (tmp_path / "thesis.txt").is_file()


def test_it_can_be_drawn():
    env = gymnasium.make("hpamdp/TrafficCorridor-v0", minutes=2, render_mode="rgb_array")
    env.reset(seed=0)
    empty = env.render()
    for _ in range(4):  # in the corridor the first three decisions are made before any time passes
        env.step(action(0, 30.0))
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (480, 480, 3)
    assert (picture != empty).any()
    env.close()
