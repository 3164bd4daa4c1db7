"""Four problems of a shop, one for each kind of action that `docs/spaces.md` explains. They need Gymnasium alone."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces


class Offer(gymnasium.Env):
    """Choose several things at once: a price, a window, and whether to advertise.

    The action is `Dict(advertise=Discrete(2), price=Box(1), window=Discrete(3))`, three components. The observation is
    the season. Each season has its window, and its price of 2, 3 or 4; advertising pays in the first season alone. The
    best reward is 1 a day, and an episode is one day.
    """

    action_space = spaces.Dict(
        advertise=spaces.Discrete(2), price=spaces.Box(1.0, 5.0, (1,)), window=spaces.Discrete(3)
    )
    observation_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        """Draw the season."""
        super().reset(seed=seed)
        self.season = int(self.np_random.integers(3))
        return self.season, {}

    def step(self, action):
        """Open for a day."""
        window = action["window"] == self.season
        advertise = action["advertise"] == (self.season == 0)
        price = abs(float(action["price"][0]) - (2.0 + self.season))
        return self.season, 0.5 * window + 0.5 * advertise - 0.25 * price, True, False, {}


class Delivery(gymnasium.Env):
    """Choose numbers that are whole: order pieces of one of four goods, or wait and lower the price.

    The action is `OneOf(Tuple(Discrete(4), Box(0, 20, int)), Box(1))`: the good and the pieces belong to ordering. The
    observation is the demand, 1 to 19 pieces. Good 2 pays 1 if the pieces are exactly the demand, less 0.1 for each
    piece too many or too few. Waiting pays at most 0.3.
    """

    action_space = spaces.OneOf(
        [spaces.Tuple([spaces.Discrete(4), spaces.Box(0, 20, (1,), np.int64)]), spaces.Box(0.0, 1.0, (1,))]
    )
    observation_space = spaces.Box(1.0, 19.0, (1,))

    def reset(self, *, seed=None, options=None):
        """Draw the demand."""
        super().reset(seed=seed)
        self.demand = int(self.np_random.integers(1, 20))
        return np.float32([self.demand]), {}

    def step(self, action):
        """Order, or wait."""
        choice, parameters = action
        if choice == 0:
            good, pieces = parameters
            reward = float(good == 2) - 0.1 * abs(int(pieces[0]) - self.demand)
        else:
            reward = 0.3 * float(parameters[0])
        return np.float32([self.demand]), reward, True, False, {}


class Warehouse(gymnasium.Env):
    """Choose within bounds that depend on the state: sell at most the stock, or order at most what fits.

    The action is `Tuple(Discrete(2), Tuple(Box(1), Box(1)))`. The entries `parameter_low` and `parameter_high` of the
    observation are the bounds of the current state. Selling pays 1 for each unit, ordering costs 0.5. A warehouse holds
    10 units and begins with up to 10. It is best to fill it and to sell all, in turns, for ten days. That pays 27.5 on
    average.
    """

    action_space = spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.Box(0.0, 10.0, (1,))] * 2)])
    observation_space = spaces.Dict(
        stock=spaces.Box(0.0, 10.0, (1,)),
        day=spaces.Box(0.0, 10.0, (1,)),
        parameter_low=spaces.Box(0.0, 10.0, (2,)),
        parameter_high=spaces.Box(0.0, 10.0, (2,)),
    )

    def reset(self, *, seed=None, options=None):
        """Draw the stock."""
        super().reset(seed=seed)
        self.stock, self.day = self.np_random.uniform(0.0, 10.0), 0
        return self._observation(), {}

    def step(self, action):
        """Sell or order."""
        choice, (sold, ordered) = action
        if choice == 0:
            change, reward = -float(sold[0]), float(sold[0])
        else:
            change, reward = float(ordered[0]), -0.5 * float(ordered[0])
        assert -1e-4 <= self.stock + change <= 10.0001, "sold what is not there, or ordered what does not fit"
        self.stock = float(np.clip(self.stock + change, 0.0, 10.0))
        self.day += 1
        return self._observation(), reward, self.day == 10, False, {}

    def _observation(self) -> dict[str, Any]:
        return {
            "stock": np.float32([self.stock]),
            "day": np.float32([self.day]),
            "parameter_low": np.zeros(2, np.float32),
            "parameter_high": np.float32([self.stock, 10.0 - self.stock]),
        }


class Tour(gymnasium.Env):
    """Choose what goes together: a van, then a road on which this van may drive.

    The action is `MultiDiscrete([2, 3])`. The info's `pair_mask` forbids the second van the first road, and the first
    van the others. The first van pays 1, the second 0.4.
    """

    action_space = spaces.MultiDiscrete([2, 3])
    observation_space = spaces.Box(0.0, 1.0, (1,))
    # Of the five discrete actions, two vans and three roads, which may follow which.
    pairs: ClassVar[np.ndarray] = np.ones((5, 5), bool)
    pairs[0, 3:] = False
    pairs[1, 2] = False

    def reset(self, *, seed=None, options=None):
        """Begin a day."""
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {"pair_mask": self.pairs}

    def step(self, action):
        """Drive."""
        van, road = (int(number) for number in action)
        assert self.pairs[van, 2 + road], f"van {van} may not drive on road {road}"
        return np.zeros(1, np.float32), 1.0 if van == 0 else 0.4, True, False, {"pair_mask": self.pairs}
