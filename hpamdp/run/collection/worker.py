"""Build the parts of a worker process: its shard of the run's environments, and a copy of the policy."""

from __future__ import annotations

import io
import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from hpamdp.children import unprotect_children
from hpamdp.config.schema import Config
from hpamdp.env.base import ProblemError
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.messages import one_line
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.run.assemble import env_and_policy, make_agent, make_env
from hpamdp.specs import PAMDPSpecs

_CPU = torch.device("cpu")


def pack_state(module: nn.Module) -> bytes:
    """Return a module's state as bytes. Unlike tensors, bytes share no memory between processes."""
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    return file.getvalue()


def unpack_state(module: nn.Module, state: bytes) -> None:
    """Load a packed state of any device into a module on the CPU."""
    module.load_state_dict(torch.load(io.BytesIO(state), map_location=_CPU, weights_only=True))


class PolicyCopy(TensorDictModuleBase):
    """A policy whose weights and buffers come from the learner's process."""

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        self.in_keys = list(policy.in_keys)
        self.out_keys = list(policy.out_keys)
        self.policy = policy
        self._cpu_before = time.process_time()

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes."""
        return self.policy(td)

    def receive(self, state: bytes) -> None:
        """Load the packed state of the learner's policy."""
        unpack_state(self.policy, state)

    def cpu_s(self) -> float:
        """Return the CPU seconds of this process since the policy was built."""
        return time.process_time() - self._cpu_before

    def generator_state(self) -> Tensor:
        """Return the state of this process's random generator."""
        return torch.get_rng_state()

    def set_generator_state(self, state: Tensor) -> None:
        """Set the state of this process's random generator."""
        torch.set_rng_state(state)


class RemoteError(RuntimeError):
    """Raised for an error in a worker, with its traceback in the text."""


@dataclass(frozen=True)
class Collected:
    """What a worker returns with a batch.

    Attributes:
        cpu_s: CPU seconds of the process since its policy was built, those of the batch included.
        batch: `[num_envs, steps_per_batch]`; None if it lies in the memory of the last batch.
        statistics: what the environments have taken by `take_new_statistics`.
    """

    cpu_s: float
    batch: TensorDictBase | None
    statistics: dict[str, Tensor]


class ShardCollector(Collector):
    """TorchRL's collector of a worker's shard; the steps have no numbers of trajectories, which nothing reads."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings, track_traj_ids=False)

    def __bool__(self) -> bool:
        """Return True. Without this method, Ray would ask for the length, which an endless collector lacks."""
        return True

    def take_new_statistics(self) -> dict[str, Tensor]:
        """Return the statistics of the steps since the last call alone."""
        return self.env.base_env.take_new_statistics()

    def begin_episodes(self, statistics: Mapping[str, Tensor]) -> None:
        """Begin new episodes, whose first observations the `statistics` scale."""
        self.env.base_env.set_statistics(statistics)
        self._carrier.update(self.env.reset())

    def begin_seeded(self, seed: int) -> None:
        """Begin the first episodes of another seed."""
        self.env.set_seed(seed, static_seed=True)
        self._carrier.update(self.env.reset())

    def collect(self, policy: bytes, statistics: Mapping[str, Tensor]) -> Collected:
        """Load the packed policy and the environments' common `statistics`, and collect a batch.

        Raises:
            ProblemError: the problem broke its contract.
            MemoryError: memory does not suffice.
            EnvironmentFaultError: a third-party environment raised an error.
            RemoteError: the environment raised any other error.
        """
        try:
            self.policy.receive(policy)
            if statistics:
                self.env.base_env.set_statistics(statistics)
            batch = self.next()
            return Collected(self.policy.cpu_s(), batch, self.take_new_statistics())
        # Of subclasses, whose constructors want other arguments, the learner's process gets the base class.
        except ProblemError as error:
            raise ProblemError(str(error)) from None
        except MemoryError as error:
            raise MemoryError(str(error)) from None
        except EnvironmentFaultError as error:
            raise EnvironmentFaultError(error.line, error.frames) from None
        except Exception as error:  # the learner's process may not have its class
            summary = one_line(f"{type(error).__name__}: {error}")
            raise RemoteError(f"{summary}\n\nIn a worker:\n{traceback.format_exc()}") from None


class SharedMemoryCollector(ShardCollector):
    """A `ShardCollector` whose batches all lie in the same shared memory."""

    _is_shared = False

    def collect(self, policy: bytes, statistics: Mapping[str, Tensor]) -> Collected:
        """Collect a batch; return it the first time, then None, since its memory holds all later batches."""
        collected = super().collect(policy, statistics)
        if self._is_shared or collected.batch is None:
            return replace(collected, batch=None)
        self._is_shared = True
        return replace(collected, batch=collected.batch.share_memory_())


class WorkingDir:
    """A working directory, which a process enters by unpickling this object.

    Like the run's process, it then finds the user's own classes there, after all installed packages. The directory may
    be missing on another machine.
    """

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[str], WorkingDir], tuple[str]]:
        return _entered, (self.path,)


def _entered(path: str) -> WorkingDir:
    if os.path.isdir(path):
        os.chdir(path)
    if path not in sys.path:
        sys.path.append(path)
    return WorkingDir(path)


@dataclass(frozen=True)
class EnvShard:
    """The environments of one worker, with everything needed to build them in its process.

    Attributes:
        working_dir: working directory of the run. It comes first, so that a process elsewhere enters it before it
            imports the classes of the other parts.
        config: config of the run.
        specs: specs of the problem.
        first_env: number of the shard's first environment in the run.
        num_envs: number of its environments.
        env_seed: seed of the environments.
        exploration_seed: seed of the worker's global generator.
        low: the packed low level of a run with `low.freeze`, whose environments play whole episodes with it.
    """

    working_dir: WorkingDir = field(default_factory=lambda: WorkingDir(os.getcwd()), kw_only=True)
    config: Config
    specs: PAMDPSpecs
    first_env: int
    num_envs: int
    env_seed: int
    exploration_seed: int
    low: bytes | None

    def make_env(self) -> TransformedEnv:
        """Build the environments, with their decisions tracked."""
        _end_with_parent()
        unprotect_children()
        torch.set_num_threads(1)
        agent = self._make_agent()
        if self.low is not None:
            unpack_state(agent.router, self.low)
        env = make_env(self.config, self.num_envs, _CPU, self.env_seed, self.first_env)
        return env_and_policy(env, agent, self.config)[0]

    def make_policy(self) -> PolicyCopy:
        """Build the policy; `receive` loads its weights later."""
        agent = self._make_agent()
        torch.manual_seed(self.exploration_seed)
        return PolicyCopy(agent.policy if self.low is None else agent.selector)

    def _make_agent(self) -> HierarchicalAgent:
        return make_agent(self.config, self.specs, _CPU)


def _end_with_parent() -> None:
    """End this process if the run's own process is killed, even in the middle of a step.

    TorchRL's worker would notice only at its next command. Ray ends its actors itself.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
