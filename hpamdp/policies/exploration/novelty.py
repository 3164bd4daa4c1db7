"""A reward for reaching states that are new.

Source: Burda, Edwards, Storkey and Klimov, *Exploration by Random Network Distillation*, 2019, arXiv 1810.12894,
section 2: a network learns to predict a random one at the visited states, and its error is the bonus. Disagreement:
Sekar, Rybkin, Daniilidis, Abbeel, Hafner and Pathak, *Planning to Explore via Self-Supervised World Models*, 2020,
arXiv 2005.05960, section 3.2: the bonus of a planned step is how much an ensemble's predictions of it differ.

Where the bonus counts is the learner's choice (`LearnerCard.novelty_by`):
- `reward`: it is added to the rewards of the steps just collected;
- `sample`: a learner with a replay buffer adds it to the rewards that it samples. It is computed then, not when a step
  is stored: a stored bonus would go on to draw the learner to places that are no longer new;
- `plan`: exploring plans add it to the rewards of predicted states. What the model learns stays without it. If an
  ensemble predicts the states, its disagreement can take the place of the network's error.

Differs from the sources:
- the bonus is a part of the reward, so it ends with the episode and has the learner's discount. Burda et al. give it
  a value of its own, which goes on across episodes;
- it is divided by the standard deviation of bonuses, not of their discounted returns, as TorchRL does, and clipped;
- vectors go through fully connected networks. Pictures go through untrained copies of the learner's encoder;
- both networks have the same layers. The predicting network of Burda et al. has two more;
- the predicting network learns from each step once, by its own optimizer. In the authors' code it learns in the four
  passes of the policy;
- the statistics of observations begin with the first batch. Burda et al. first let a random agent act;
- disagreement is a standard deviation of predicted changes of the state, added to the problem's reward. In Sekar et al.
  it is a variance of predicted embeddings, and the only reward while exploring.

Networks, loss and statistics are TorchRL's RNDLoss and RunningMeanStd. Its RNDTransform does not fit: it computes the
bonus in the environment, where each worker would have statistics of its own and no sample could be valued again.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.transforms import RunningMeanStd
from torchrl.objectives import RNDLoss

from hpamdp import keys
from hpamdp.devices import Device, checked_device
from hpamdp.policies.base import Bonus, Learner
from hpamdp.policies.encoders.base import JoinedEncoders
from hpamdp.policies.exploration.base import Explored
from hpamdp.policies.exploration.new_states import NoveltyPolicy, RewardsNewStates
from hpamdp.policies.exploration.options import CARDS, NoveltyOptions
from hpamdp.policies.shared.gradients import descend
from hpamdp.policies.shared.hybrid_actor import hidden_layers
from hpamdp.policies.shared.networks import OutputLinear
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


class RandomDistillation(nn.Module):
    """A random network, and one that learns to predict it; its error says how new a state is.

    Args:
        specs: of the learner whose states they are.
        options: the settings.
    """

    def __init__(self, specs: PAMDPSpecs, options: NoveltyOptions) -> None:
        super().__init__()
        self.largest = options.largest
        scale = None if specs.has_pictures else RunningMeanStd((specs.observation_dim,))
        self.loss = RNDLoss(
            _network(specs, options),
            _network(specs, options),
            obs_rms=scale,
            obs_clip=options.largest,
            reduction="none",
            update_fraction=1.0,
        )
        self.scale = RunningMeanStd()

    def errors(self, observation: Tensor) -> Tensor:
        """Return the squared errors `[*B]` of the prediction at observations `[*B, observation_dim]`."""
        rows = observation.reshape(-1, observation.shape[-1])
        step = TensorDict({"next": {keys.OBSERVATION: rows}}, [len(rows)])
        errors: Tensor = self.loss(step)["loss_predictor"]
        return errors.reshape(observation.shape[:-1])

    @torch.no_grad()
    def bonus(self, observation: Tensor) -> Tensor:
        """Return the bonus `[*B]` for reaching observations `[*B, observation_dim]`, from 0 to `largest`."""
        return (self.errors(observation) / self.scale.var.clamp(min=1e-8).sqrt()).clamp(max=self.largest)

    @torch.no_grad()
    def see(self, observation: Tensor) -> None:
        """Add observations `[N, observation_dim]` to the statistics, then their errors."""
        if self.loss.obs_rms is not None:
            self.loss.obs_rms.update(observation)
        self.scale.update(self.errors(observation))


def _network(specs: PAMDPSpecs, options: NoveltyOptions) -> nn.Sequential:
    """Return a network from observations to features, with orthogonal initial weights as in the source."""
    layers: list[nn.Module] = []
    num_inputs = specs.observation_dim
    if specs.has_pictures:
        encoders = JoinedEncoders(specs)
        layers, num_inputs = [encoders], encoders.feature_specs.observation_dim
    output = OutputLinear(options.hidden_dims[-1], options.num_features, dtype=torch.float32)
    nn.init.orthogonal_(output.weight, math.sqrt(2.0))
    nn.init.zeros_(output.bias)
    return nn.Sequential(*layers, hidden_layers(num_inputs, options.hidden_dims), output)


class Novelty(RewardsNewStates):
    """A bonus for states that are new, by random network distillation or an ensemble's disagreement."""

    Options = NoveltyOptions
    card = CARDS["Novelty"]

    def __init__(self, learner: Learner, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        options = NoveltyOptions.of(options, settings)
        super().__init__(learner, options.weight)
        self.options = options
        self.network: RandomDistillation | None = None
        if not self._asks_ensemble(learner):
            self.network = RandomDistillation(learner.specs, self.options)
            self.to(checked_device(self, device))
            predictor = self.network.loss.predictor_network.parameters()
            self.optimizer = torch.optim.Adam(predictor, lr=self.options.lr, fused=True)
        learner.take_bonus(Bonus(self.options.weight, None if self.network is None else self.network.bonus))

    def _asks_ensemble(self, learner: Learner) -> bool:
        """Return whether the bonus is an ensemble's disagreement.

        Raises:
            SettingError: it should be, but the learner has no such ensemble.
        """
        if self.options.in_plans == "disagreement" and not learner.card.knows_disagreement:
            raise SettingError(f"in_plans=disagreement: {type(learner).__name__} has no ensemble that predicts states")
        return learner.card.knows_disagreement and self.options.in_plans != "distillation"

    def acting_policy(self, learner: Learner) -> TensorDictModuleBase:
        """Return the learner's policy, with the network if its plans need it."""
        if not self.adds_to_plans or self.network is None:
            return learner.policy
        return NoveltyPolicy(learner.policy, self.network)

    def learn(self, batch: TensorDictBase, mask: Tensor) -> Explored:
        """Learn which states are no longer new; return the bonus from before this update, if it is due."""
        if self.network is None or not mask.any():
            return Explored(None, {})
        observation = batch.get(("next", keys.OBSERVATION))[mask]
        self.network.see(observation)
        bonus = self.network.bonus(observation)
        return self.explored(bonus, mask, {"novelty": self._update(observation)})

    def _update(self, observation: Tensor) -> float:
        """Learn from observations `[N, observation_dim]` once, in random minibatches; return the mean error before."""
        assert self.network is not None
        num = max(1, round(len(observation) / self.options.batch_size))
        errors = []
        for rows in torch.randperm(len(observation), device=observation.device).tensor_split(num):
            error = self.network.errors(observation[rows]).mean()
            errors.append(descend(self.optimizer, error))
        return torch.stack(errors).mean().item()

    def stateful(self) -> dict[str, Any]:
        """Return the optimizer of the predicting network, if there is one."""
        return {} if self.network is None else {"optimizer": self.optimizer}
