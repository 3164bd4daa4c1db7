"""Ten problems of the kinds that people have at work, as Gymnasium environments in plain Python.

Each action is a choice together with a number: which supplier and how much, which mode and which power. Rewards and
observations have their natural units. `optimum.py` computes the best return of each by dynamic programming.

The rules of a problem are one function that takes floats or arrays: the environment calls it with floats, the dynamic
programme with arrays.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Space, Tuple

# A number of a state, or the numbers of many states.
Value = Any


class OwnProblem(gymnasium.Env):
    """Base class: a state of two numbers, a time limit, and a random event at every step.

    Attributes:
        steps: steps of an episode, after which it is truncated.
        events: what may happen at a step, each with the same probability.
        grid: values of both numbers of the state for the dynamic programme.
        limits: largest number of each choice; 0 if the choice takes no number.
    """

    steps: ClassVar[int]
    events: ClassVar[tuple[Any, ...]]
    grid: ClassVar[tuple[np.ndarray, np.ndarray]]
    limits: ClassVar[tuple[float, ...]]

    def __init__(self) -> None:
        self.action_space: Space = Tuple((Discrete(len(self.limits)), Box(0.0, 1.0, (1,))))
        self.time = 0
        self.earned = 0.0  # in the last step
        self.state: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def amounts(cls, choice: int, num: int) -> np.ndarray:
        """Return amounts of a choice `[M]` for the dynamic programme: `num` from 0 to its limit, or 0 alone."""
        return np.linspace(0.0, cls.limits[choice], num) if cls.limits[choice] else np.zeros(1)

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return the state at the beginning of an episode."""
        raise NotImplementedError

    @classmethod
    def rules(
        cls, time: int, state: tuple[Value, Value], choice: int, amount: Value, event: Any
    ) -> tuple[tuple[Value, Value], Value, Value]:
        """Return the next state, the reward and whether the episode terminates.

        Args:
            time: steps so far.
            state: the two numbers of the state.
            choice: number of the choice.
            amount: of the choice, from 0 to its limit.
            event: one of `events`.
        """
        raise NotImplementedError

    def observe(self) -> Any:
        """Return the observation of the state: its two numbers and the time."""
        return np.array([*self.state, self.time], np.float32)

    def read(self, action: Any) -> tuple[int, float]:
        """Return the choice and its amount, given an action of the space: a fraction of its limit."""
        choice = int(action[0])
        return choice, float(action[1][0]) * self.limits[choice]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.time, self.earned = 0, 0.0
        self.state = self.start(self.np_random)
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        event = self.events[self.np_random.integers(len(self.events))]
        self.state, reward, is_over = self.rules(self.time, self.state, *self.read(action), event)
        self.time, self.earned = self.time + 1, float(reward)
        return self.observe(), self.earned, bool(is_over), self.time >= self.steps, {}


class Battery(OwnProblem):
    """A battery at the grid for a day of half hours: idle, charge or discharge, with a power in kW.

    State: energy in kWh, deviation of the price in EUR/kWh. The bounds of the power depend on the energy; the
    environment gives them with the observation. Reward: EUR.
    """

    steps = 48
    events = (-0.03, -0.01, 0.01, 0.03)
    grid = (np.linspace(0.0, 10.0, 41), np.linspace(-0.15, 0.15, 13))
    limits = (0.0, 5.0, 5.0)
    prices = tuple(
        0.2 + 0.06 * math.sin(2 * math.pi * (t - 15) / 24) + 0.04 * math.sin(math.pi * t / 48) for t in range(49)
    )

    def __init__(self) -> None:
        super().__init__()
        power = Box(0.0, 5.0, (1,))
        self.action_space = Tuple((Discrete(3), Tuple((Box(0.0, 0.0, (0,)), power, power))))
        bounds = Box(0.0, 5.0, (2,))
        low, high = np.array([0.0, 0.0, 0.0], np.float32), np.array([10.0, 1.0, 48.0], np.float32)
        self.observation_space = Dict(state=Box(low, high), parameter_low=bounds, parameter_high=bounds)

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a battery that is less than half full."""
        return float(rng.uniform(0.0, 5.0)), 0.0

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return what a power brings; energy that is left at the end of the day is worth 0.15 EUR/kWh."""
        energy, deviation = state
        price = cls.prices[time] + deviation
        if choice == 1:
            power = np.minimum(amount, (10.0 - energy) / 0.475)
            energy = energy + 0.475 * power
            reward = -0.5 * power * (price + 0.015) - 0.01
        elif choice == 2:
            power = np.minimum(amount, energy * 1.9)
            energy = energy - power / 1.9
            reward = 0.5 * power * (price - 0.015) - 0.01
        else:
            reward = 0.0 * energy
        if time == cls.steps - 1:
            reward = reward + 0.15 * energy
        return (energy, np.clip(0.8 * deviation + event, -0.15, 0.15)), reward, False

    def read(self, action: Any) -> tuple[int, float]:
        """Return the choice and its power."""
        choice = int(action[0])
        return choice, float(action[1][choice][0]) if choice else 0.0

    def observe(self) -> dict[str, np.ndarray]:
        """Return energy, price, half hour, and the bounds of the powers."""
        energy, deviation = self.state
        highest = [min(5.0, (10.0 - energy) / 0.475), min(5.0, energy * 1.9)]
        return {
            "state": np.array([energy, self.prices[self.time] + deviation, self.time], np.float32),
            "parameter_low": np.zeros(2, np.float32),
            "parameter_high": np.clip(np.array(highest, np.float32), 0.0, 5.0),
        }


class Inventory(OwnProblem):
    """A stock for 60 days: wait, or order from a cheap supplier for large orders or a quick one for small ones.

    State: units in stock, level of the demand in units a day. Reward: EUR.
    """

    steps = 60
    events = tuple((drift, factor) for drift in (-2.0, 0.0, 2.0) for factor in (0.6, 1.0, 1.4))
    grid = (np.linspace(0.0, 200.0, 101), np.linspace(8.0, 32.0, 9))
    limits = (0.0, 100.0, 30.0)
    fixed, unit = (0.0, 90.0, 10.0), (0.0, 5.0, 7.0)
    week = (1.0, 0.8, 0.8, 1.0, 1.4, 1.7, 0.3)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(-np.inf, np.inf, (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a stock of about two days."""
        return float(rng.uniform(20.0, 60.0)), 20.0

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return sales less purchases, storage and lost sales; a unit is worth 4 EUR at the end."""
        stock, level = state
        drift, factor = event
        demand = level * cls.week[time % 7] * factor
        stock = stock + amount
        sold = np.minimum(stock, demand)
        stock = np.minimum(stock - sold, 200.0)
        reward = 10.0 * sold - cls.fixed[choice] - cls.unit[choice] * amount - 0.1 * stock - 2.0 * (demand - sold)
        if time == cls.steps - 1:
            reward = reward + 4.0 * stock
        return (stock, np.clip(20.0 + 0.9 * (level - 20.0) + drift, 8.0, 32.0)), reward, False


class Heating(OwnProblem):
    """A house for a day of quarter hours: off, the heat pump or the electric heater, with a power.

    State: temperature inside and deviation of the one outside in °C. Reward: EUR, with 0.02 EUR for each °C² of
    discomfort in a quarter hour while somebody is at home.
    """

    steps = 96
    events = (-0.6, -0.2, 0.2, 0.6)
    grid = (np.linspace(5.0, 30.0, 76), np.linspace(-5.0, 5.0, 9))
    limits = (0.0, 3.0, 6.0)
    outside = tuple(2.0 + 4.0 * math.sin(2 * math.pi * (t - 36) / 96) for t in range(97))
    tariff = tuple(0.15 if t < 24 or t >= 88 else 0.45 if 68 <= t < 80 else 0.3 for t in range(97))
    is_home = tuple(24 <= t < 36 or t >= 64 for t in range(97))

    def __init__(self) -> None:
        super().__init__()
        self.action_space = Dict(mode=Discrete(3), power=Box(0.0, 1.0, (1,)))
        low, high = (
            np.array([5.0, -20.0, 0.0, 0.0, 0.0], np.float32),
            np.array([30.0, 40.0, 1.0, 96.0, 1.0], np.float32),
        )
        self.observation_space = Box(low, high)

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a house that is a little cold."""
        return float(rng.uniform(15.0, 20.0)), float(rng.uniform(-3.0, 3.0))

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return what heat costs, and the discomfort."""
        inside, deviation = state
        outside = cls.outside[time] + deviation
        heat = amount * (2.5 + 0.08 * outside) if choice == 1 else amount
        inside = np.clip(inside + 0.25 * (heat - 0.25 * (inside - outside)) / 2.0, 5.0, 30.0)
        reward = -0.25 * cls.tariff[time] * amount - (0.02 if choice == 1 else 0.0)
        if cls.is_home[time]:
            reward = reward - 0.02 * (inside - 21.0) ** 2
        return (inside, np.clip(0.95 * deviation + event, -5.0, 5.0)), reward, False

    def read(self, action: Any) -> tuple[int, float]:
        """Return the mode and its power."""
        return super().read((action["mode"], action["power"]))

    def observe(self) -> np.ndarray:
        """Return both temperatures, tariff, quarter hour, and whether somebody is at home."""
        inside, deviation = self.state
        time = self.time
        seen = [inside, self.outside[time] + deviation, self.tariff[time], time, self.is_home[time]]
        return np.array(seen, np.float32)


class Queue(OwnProblem):
    """A service for 100 quarter hours: admit all, admit half, or call a second crew, with the speed of the first one.

    State: customers who wait, rate of arrivals. Reward: EUR.
    """

    steps = 100
    events = tuple((drift, factor) for drift in (-0.5, 0.5) for factor in (0.5, 1.0, 1.5))
    grid = (np.concatenate([np.linspace(0.0, 40.0, 41), np.linspace(45.0, 200.0, 32)]), np.linspace(2.0, 14.0, 9))
    limits = (10.0, 10.0, 10.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(0.0, 1000.0, (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a short queue."""
        return float(rng.uniform(0.0, 20.0)), float(rng.uniform(4.0, 10.0))

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return what customers pay, less the cost of speed, of waiting and of a second crew."""
        queue, rate = state
        drift, factor = event
        admitted = rate * factor * (0.5 if choice == 1 else 1.0)
        served = np.minimum(queue + admitted, amount + (8.0 if choice == 2 else 0.0))
        queue = np.minimum(queue + admitted - served, 200.0)
        reward = 10.0 * served - 0.6 * amount**2 - 0.5 * queue - 0.02 * queue**2 - (50.0 if choice == 2 else 0.0)
        mean = 7.0 + 3.0 * math.sin(2 * math.pi * time / 50)
        return (queue, np.clip(rate + 0.2 * (mean - rate) + drift, 2.0, 14.0)), reward, False


class Irrigation(OwnProblem):
    """A field for a season of 120 days: nothing, drip or sprinkler, with mm of water. The harvest is paid at the end.

    State: moisture of the soil in mm, crop in t/ha. Reward: EUR/ha.
    """

    steps = 120
    events = (0.0, 0.0, 0.0, 0.0, 4.0, 14.0)
    grid = (np.linspace(0.0, 100.0, 51), np.linspace(0.0, 12.0, 49))
    limits = (0.0, 8.0, 25.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(0.0, np.inf, (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a field in spring."""
        return float(rng.uniform(30.0, 70.0)), 0.3

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return the cost of water, and at the end the value of the harvest, 250 EUR/t."""
        moisture, crop = state
        need = 3.0 + 2.0 * math.sin(math.pi * time / 120)
        water = amount * (0.0, 0.95, 0.75)[choice]
        moisture = np.clip(moisture + water + event - need, 0.0, 100.0)
        health = np.exp(-(((moisture - 60.0) / 25.0) ** 2))
        crop = crop + 0.09 * crop * (1.0 - crop / 12.0) * health
        reward = -1.2 * amount if choice == 1 else -0.7 * amount - (12.0 if choice == 2 else 0.0)
        if time == cls.steps - 1:
            reward = reward + 250.0 * crop
        return (moisture, crop), reward, False


class Vehicle(OwnProblem):
    """A vehicle on 2 km of hills with a slow zone: coast, accelerate or brake, each second, with a strength.

    State: position in m, speed in m/s. Reward: seconds, energy, fines and the speed at the end, in one unit.
    """

    steps = 200
    events = (-0.1, 0.1)
    grid = (np.linspace(0.0, 2000.0, 161), np.linspace(0.0, 35.0, 51))
    limits = (0.0, 2.0, 4.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(0.0, np.array([2000.0, 35.0, 2000.0], np.float32), (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a vehicle near the beginning."""
        return float(rng.uniform(0.0, 200.0)), float(rng.uniform(0.0, 15.0))

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return time, energy and fines. Braking hard at the end is necessary: arriving fast costs its square."""
        position, speed = state
        push = amount if choice == 1 else -amount
        slope = 0.4 * np.sin(2 * np.pi * position / 700.0)
        after = np.clip(speed + push - slope - 0.0008 * speed**2 + event, 0.0, 35.0)
        is_slow = (position > 800.0) & (position < 1200.0)
        excess = np.maximum(after - np.where(is_slow, 14.0, 25.0), 0.0)
        position = np.minimum(position + 0.5 * (speed + after), 2000.0)
        is_over = position >= 2000.0
        reward = -1.0 - (0.04 * amount * speed if choice == 1 else 0.0) - 0.5 * excess**2
        reward = reward - np.where(is_over, 0.2 * after**2, 0.0)
        if time == cls.steps - 1:
            reward = reward - 0.1 * (2000.0 - position)
        return (position, after), reward, is_over

    def observe(self) -> np.ndarray:
        """Return position, speed, and the distance to the slow zone, 0 in it and after it."""
        position, speed = self.state
        return np.array([position, speed, max(800.0 - position, 0.0)], np.float32)


class Pricing(OwnProblem):
    """A shop's season of 90 days for one article: its price, a discount, or advertising, with a fraction or EUR.

    State: stock, and the attention that the article has. Reward: EUR. Advertising pays later, by attention.
    """

    steps = 90
    events = tuple((drift, factor) for drift in (-0.1, 0.1) for factor in (0.5, 1.0, 1.5))
    grid = (np.linspace(0.0, 300.0, 61), np.linspace(0.0, 4.0, 17))
    limits = (0.0, 0.6, 40.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(0.0, 300.0, (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a full store and little attention."""
        return float(rng.uniform(200.0, 300.0)), float(rng.uniform(0.0, 1.0))

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return what is sold, less the cost of storing and advertising; what is left at the end is worth little."""
        stock, attention = state
        drift, factor = event
        discount, spent = (amount if choice == kind else 0.0 * amount for kind in (1, 2))
        sold = np.minimum(stock, (1.0 + attention) * factor * np.exp(2.5 * discount))
        stock = stock - sold
        reward = 20.0 * (1.0 - discount) * sold - 0.05 * stock - spent
        if time == cls.steps - 1:
            reward = reward + 2.0 * stock
        return (stock, np.clip(0.95 * attention + 0.01 * spent + drift, 0.0, 4.0)), reward, stock <= 0.0


class Machine(OwnProblem):
    """A machine that wears unseen: produce at a speed, or repair it. What a step earned tells whether it made scrap.

    State: probability that it is worn, given all that was seen, and the price in EUR. Only the price is observed,
    beside the last speed, what the last step earned, and the time; so a memory may help. Drawing scrap with this
    probability gives the same observations and rewards as drawing the wear itself. Reward: EUR.
    """

    steps = 100
    events = tuple((drift, (k + 0.5) / 16) for drift in (-0.1, 0.1) for k in range(16))
    grid = (np.linspace(0.0, 1.0, 41), np.linspace(0.5, 1.5, 9))
    limits = (1.0, 0.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(-100.0, 100.0, (4,))
        self.speed = 0.0

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a machine that was repaired, and a price."""
        return 0.0, float(rng.uniform(0.5, 1.5))

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return what is sold, or the cost of scrap or of a repair; speed wears the machine out."""
        worn, price = state
        drift, draw = event
        if choice == 1:
            worn, reward = 0.0 * worn, -6.0 + 0.0 * worn
        else:
            scrap = 0.05 + 0.55 * worn
            is_scrap = draw < scrap
            worn = np.where(is_scrap, 0.6 * worn / scrap, 0.4 * worn / (1.0 - scrap))
            worn = worn + (1.0 - worn) * (0.02 + 0.08 * amount**2)
            reward = np.where(is_scrap, -5.0 * amount, 10.0 * price * amount)
        return (worn, np.clip(price + drift, 0.5, 1.5)), reward, False

    def read(self, action: Any) -> tuple[int, float]:
        """Return the choice and its speed, which is observed afterwards."""
        choice, self.speed = super().read(action)
        return choice, self.speed

    def observe(self) -> np.ndarray:
        """Return the last speed, what the last step earned, the price and the time."""
        return np.array([self.speed if self.time else 0.0, self.earned, self.state[1], self.time], np.float32)


class Greenhouse(OwnProblem):
    """A greenhouse for a day of quarter hours: heating and window, each off or on with a power or an opening.

    State: temperature in degrees, humidity in percent. An action has two components. Reward: EUR.
    """

    steps = 96
    events = tuple((cloud, draught) for cloud in (0.5, 1.0) for draught in (-2.0, 2.0))
    grid = (np.linspace(0.0, 45.0, 31), np.linspace(20.0, 100.0, 17))
    limits = (0.0, 1.0, 1.0, 1.0)

    def __init__(self) -> None:
        super().__init__()
        self.action_space = Dict(
            heating=Tuple((Discrete(2), Box(0.0, 1.0, (1,)))), window=Tuple((Discrete(2), Box(0.0, 1.0, (1,))))
        )
        self.observation_space = Box(-100.0, 100.0, (3,))

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return a cool and humid greenhouse."""
        return float(rng.uniform(10.0, 18.0)), float(rng.uniform(60.0, 95.0))

    @classmethod
    def amounts(cls, choice: int, num: int) -> np.ndarray:
        """Return pairs of a power and an opening `[2, M]`."""
        heats, openings = ((super(Greenhouse, cls).amounts(is_on, num)) for is_on in (choice % 2, choice // 2))
        return np.stack([each.reshape(-1) for each in np.meshgrid(heats, openings)])

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return growth less the cost of heat; `choice` counts heating on as 1 and the window open as 2."""
        temperature, humidity = state
        cloud, draught = event
        heat, opening = amount
        heat, opening = heat * float(choice % 2), opening * float(choice // 2)
        sun = max(0.0, math.sin(math.pi * (time - 24) / 48))
        outside = 8.0 + 8.0 * sun + draught
        growth = np.exp(-(((temperature - 23.0) / 5.0) ** 2)) * np.clip((100.0 - humidity) / 15.0, 0.0, 1.0)
        reward = (0.3 + sun) * growth - 0.25 * heat - (0.02 if choice // 2 else 0.0)
        warmed = temperature + 2.5 * heat + 2.0 * cloud * sun - (0.04 + 0.25 * opening) * (temperature - outside)
        dried = humidity + 0.12 * temperature - 1.5 * heat - (0.01 + 0.3 * opening) * (humidity - 45.0)
        return (np.clip(warmed, 0.0, 45.0), np.clip(dried, 20.0, 100.0)), reward, False

    def read(self, action: Any) -> tuple[int, Any]:
        """Return which of the two are on, and the pair of power and opening."""
        (is_on, heat), (is_open, opening) = action["heating"], action["window"]
        return int(is_on) + 2 * int(is_open), (float(heat[0]), float(opening[0]))


class Picking(OwnProblem):
    """Twenty things on a belt, each seen in a picture: leave it, or pick it by sucker or gripper, and at which place.

    State: place and size of the thing. The sucker holds large things and the gripper small ones. Reward: things.
    """

    steps = 20
    events = tuple(((k * 0.618034) % 1.0, (k + 0.5) / 64) for k in range(64))
    grid = (np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 41))
    limits = (0.0, 1.0, 1.0)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(0, 255, (36, 36, 1), np.uint8)

    @classmethod
    def start(cls, rng: np.random.Generator) -> tuple[float, float]:
        """Return the first thing."""
        return float(rng.uniform()), float(rng.uniform())

    @classmethod
    def rules(cls, time, state, choice, amount, event):
        """Return how well the thing is held, less the cost of trying, and the next thing."""
        place, size = state
        fits = (size > 0.5) if choice == 1 else (size <= 0.5)
        held = np.where(fits, np.maximum(0.0, 1.0 - ((amount - place) / 0.25) ** 2), 0.0)
        reward = held - 0.3 if choice else 0.0 * place
        return event, reward, False

    def observe(self) -> np.ndarray:
        """Return the picture: a bright disc on a dark belt."""
        place, size = self.state
        across = (np.arange(36.0) - 4.0 - 28.0 * place) ** 2
        disc = across + (np.arange(36.0)[:, None] - 18.0) ** 2 < (2.0 + 6.0 * size) ** 2
        return (disc * 255).astype(np.uint8)[..., None]


TUNED: dict[str, type[OwnProblem]] = {
    "battery": Battery,
    "inventory": Inventory,
    "heating": Heating,
    "irrigation": Irrigation,
    "vehicle": Vehicle,
}
HELD: dict[str, type[OwnProblem]] = {
    "queue": Queue,
    "pricing": Pricing,
    "machine": Machine,
    "greenhouse": Greenhouse,
    "picking": Picking,
}
PROBLEMS = TUNED | HELD
EPISODES = 64
EPISODE_SEEDS = tuple(range(900_000, 900_000 + EPISODES))  # of the fixed episodes on which all players are scored
