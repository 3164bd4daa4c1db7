"""Write an agent's greedy policy to an ONNX file, which runs without torch and without this package.

The file holds one graph. It is traced from the modules that act in training and evaluation.
"""

from __future__ import annotations

import io
import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType

from hpamdp import __version__, keys
from hpamdp.acting import acting
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.decisions import OptionLength
from hpamdp.env.gymnasium_form import GymnasiumForm
from hpamdp.files import replacing
from hpamdp.policies.agent import HierarchicalAgent, OptionRouter, with_option
from hpamdp.policies.base import Learner, Level, Selector
from hpamdp.policies.exploration.base import Exploration
from hpamdp.specs import PAMDPSpecs

# An ONNX graph has each name once, so the option that comes in is not called as the one that goes out.
HELD_OPTION, HELD_LENGTH = "held_option", "held_length"
_OUTPUTS = ("discrete", "parameters", keys.OPTION, keys.OPTION_LENGTH)
_PACKAGES = ("onnx", "onnxscript")
_EXAMPLE_ROWS = 4  # more than 1, which tracing would take for a constant


class GreedyStep(nn.Module):
    """A greedy step of an agent, from tensors to tensors.

    Every learner acts in every row, because a graph cannot depend on which options occur in a batch.

    Args:
        agent: the agent.
        form: of the problem, which tells how observations are scaled and parameters become actions.
        option_length: steps of an option, as in `DecisionTracker`.

    Attributes:
        names: of the inputs, in order.
    """

    def __init__(self, agent: HierarchicalAgent, form: GymnasiumForm, option_length: OptionLength) -> None:
        super().__init__()
        self.specs: PAMDPSpecs = agent.specs
        self.selector: Selector | None = agent.selector
        self.router: OptionRouter = agent.router
        self.device = agent.frames.device
        self.option_length = option_length
        self.pairs = agent.pairs
        self.observed_dtype = form.observed_dtype()
        self.scaling = self._tensors(form.scaling())
        self.parameter_map = self._tensors(form.parameter_map())
        self.option_actions: Tensor | None = None
        if self.specs.has_action_mask and self.specs.option_actions is not None:
            self.option_actions = torch.tensor(self.specs.option_actions, device=self.device)
        self.greedy_choice: Callable[[TensorDictBase], Tensor] | None = None
        if self.selector is not None:
            self.greedy_choice = self.selector.greedy_choice()
        self.names = list(self.example())

    def _tensors(self, parts: object | None) -> dict[str, Tensor]:
        """Return the arrays of a dataclass as tensors; none if there is no dataclass."""
        arrays = {} if parts is None else vars(parts)
        return {name: torch.as_tensor(array, device=self.device) for name, array in arrays.items()}

    def example(self) -> dict[str, Tensor]:
        """Return inputs of the right shapes, by name."""
        specs, num = self.specs, _EXAMPLE_ROWS
        inputs = {keys.OBSERVATION: torch.zeros(num, specs.observation_dim, dtype=self.observed_dtype)}
        if specs.has_action_mask:
            inputs[keys.ACTION_MASK] = torch.ones(num, specs.num_discrete, dtype=torch.bool)
        if specs.has_option_mask and self.option_actions is None:
            inputs[keys.OPTION_MASK] = torch.ones(num, specs.num_options, dtype=torch.bool)
        if self.selector is not None:
            inputs[HELD_OPTION] = torch.zeros(num, dtype=torch.long)
            inputs[keys.IS_DECISION] = torch.ones(num, dtype=torch.bool)
        if self.pairs is not None:
            inputs[HELD_LENGTH] = torch.ones(num, dtype=torch.long)
        return {name: value.to(self.device) for name, value in inputs.items()}

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the discrete actions, the parameters `[N, num_parameters]` and, if any, the options `[N]`.

        With one component the discrete actions are `[N]`, with several `[N, num_components]`.

        The options' lengths `[N]` follow if the agent chooses them.

        Args:
            inputs: as `names` says: the observation as a vector `[N, observation_dim]`; the masks, if the problem has
                any; the held option `[N]`, and whether a new one is due, bool `[N]`, if the agent chooses options; the
                held length `[N]` if it chooses lengths.
        """
        given = dict(zip(self.names, inputs, strict=True))
        td = TensorDict({keys.OBSERVATION: self._scaled(given[keys.OBSERVATION])}, [inputs[0].shape[0]])
        for name in (keys.ACTION_MASK, keys.OPTION_MASK):
            if name in given:
                td.set(name, given[name])
        if self.option_actions is not None:
            allowed = self.option_actions & given[keys.ACTION_MASK].unsqueeze(-2)
            td.set(keys.OPTION_MASK, self.specs.components.any_of_each(allowed))
        if self.selector is not None:
            held = (given[HELD_OPTION], *([] if self.pairs is None else [given[HELD_LENGTH]]))
            chosen = self._choice(td, held, given[keys.IS_DECISION])
            td.set(keys.OPTION, chosen[0])
            return (*self._action(td), *chosen)
        return self._action(td)

    def _scaled(self, vectors: Tensor) -> Tensor:
        if not self.scaling:
            return vectors
        scaling = self.scaling
        vectors = vectors.double().clamp(scaling["low"], scaling["high"])
        scaled = (vectors - scaling["centre"]) / scaling["width"]
        return scaled.clamp(-scaling["limit"], scaling["limit"]).float()

    def _choice(self, td: TensorDictBase, held: tuple[Tensor, ...], is_decision: Tensor) -> tuple[Tensor, ...]:
        """Return the options `[N]`, and their lengths if these are chosen.

        They are new in rows in which a decision is due or the held option ends.
        """
        assert self.selector is not None and self.greedy_choice is not None
        choose, pairs = self.greedy_choice, self.pairs
        # At a decision the held option may be any number, even one that no option has.
        option = torch.where(is_decision, 0, held[0])
        td.set(keys.IS_DECISION, is_decision.unsqueeze(-1)).set(keys.OPTION, option)
        if self.option_actions is not None and self.option_length is not None:
            is_decision = is_decision | ~td.get(keys.OPTION_MASK).gather(-1, option.unsqueeze(-1)).squeeze(-1)
        if self.selector.decides_ends:
            is_decision = is_decision | self.selector.ends(td)
        fresh = (choose(td),) if pairs is None else pairs.split(choose(pairs.with_pairs(td)))
        return tuple(torch.where(is_decision, new, old) for new, old in zip(fresh, held, strict=True))

    def _action(self, td: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the discrete actions, and the parameters of each row's own learner as numbers of the action space."""
        seen = td.select(*self.router.in_keys, strict=False)
        if self.router.is_shared:
            seen = with_option(seen, self.specs.num_options)
        acted = [policy(seen.copy()) for policy in self.router.policies]
        discrete, parameters = acted[0].get(keys.DISCRETE), acted[0].get(keys.PARAMETERS)
        for option, own in enumerate(acted[1:], 1):
            rows = td.get(keys.OPTION) == option
            chosen = own.get(keys.DISCRETE)
            discrete = torch.where(rows.reshape(-1, *[1] * (chosen.ndim - 1)), chosen, discrete)
            parameters = torch.where(rows.unsqueeze(-1), own.get(keys.PARAMETERS), parameters)
        return discrete, self._mapped(parameters)

    def _mapped(self, parameters: Tensor) -> Tensor:
        """Return the numbers of the action space, float64 if they are not the agent's parameters."""
        if not self.parameter_map:
            return parameters
        columns = self.parameter_map
        low, high = columns["low"], columns["high"]
        parameters = parameters.double()
        fraction = 0.5 * (parameters.clamp(-1.0, 1.0) + 1.0)
        width = high - low
        offset = torch.where(columns["is_many"], (fraction * (width + 1.0)).floor(), fraction * width)
        numbers = torch.where(columns["is_unit"], low + offset, parameters + columns["shift"])
        return torch.where(columns["is_whole"], numbers.round(), numbers).clamp(low, high)


def export_onnx(
    path: Path, agent: HierarchicalAgent, env: PAMDPEnv, option_length: OptionLength, about: Mapping[str, Any]
) -> None:
    """Write an agent's greedy policy to an ONNX file.

    Args:
        path: of the file; an existing one is replaced.
        agent: the agent.
        env: its problem.
        option_length: steps of an option, as in `DecisionTracker`.
        about: further properties of the file.

    Raises:
        ConfigError: a package is missing, or the agent cannot be exported.
        OSError: the file cannot be written.
    """
    missing = [name for name in _PACKAGES if find_spec(name) is None]
    if missing:
        raise ConfigError(f"export: {' and '.join(missing)} not installed; pip install 'hpamdp[onnx]'")
    _check_levels(agent)
    with acting(ExplorationType.DETERMINISTIC), torch.no_grad(), _quiet():
        step = GreedyStep(agent, env.gymnasium_form(), option_length)
        if agent.option_lengths:
            about = {"option_lengths": agent.option_lengths, **about}
        try:
            data = _traced(step, {**properties(agent.specs, env, option_length), **about})
        except RuntimeError as error:
            reason = str(error).strip().partition("\n")[0]
            raise ConfigError(f"export: {_names(agent)} cannot be traced: {reason:.200}") from error
    with replacing(path) as partial:
        partial.write_bytes(data)


def properties(specs: PAMDPSpecs, env: PAMDPEnv, option_length: OptionLength) -> dict[str, Any]:
    """Return what a reader of the file needs to know of a problem, as values for JSON."""
    form = env.gymnasium_form()
    found = form.parameter_map()
    low, high = (specs.parameter_low, specs.parameter_high) if found is None else (found.low, found.high)
    whole = specs.integer_parameters if found is None or not found.is_whole.any() else found.is_whole.tolist()
    discrete_starts, option_start = form.starts()
    return {
        "discrete_names": [str(name) for name in env.discrete_names or range(specs.num_discrete)],
        "option_names": specs.option_names,
        "parameter_dims": specs.parameter_dims,
        "discrete_starts": discrete_starts or (0,) * len(specs.components.sizes),
        "option_start": option_start,
        "parameter_low": [*low],
        "parameter_high": [*high],
        "component_sizes": specs.components.sizes,
        "integer_parameters": whole,
        "option_length": None if option_length in (None, math.inf, "chosen") else option_length,
        "hpamdp_version": __version__,
    }


def _levels(agent: HierarchicalAgent) -> list[Level]:
    return [level for level in (agent.selector, *agent.learners) if isinstance(level, Level)]


def _names(agent: HierarchicalAgent) -> str:
    return " with ".join(dict.fromkeys(type(level).__name__ for level in _levels(agent)))


def _check_levels(agent: HierarchicalAgent) -> None:
    """Refuse levels that are known to have no export.

    Raises:
        ConfigError: there is one.
    """
    if agent.specs.has_pictures:
        raise ConfigError(f"export: {_names(agent)} cannot be exported: it observes pictures")
    for level in _levels(agent):
        refusal = level.export_refusal
        if refusal is None and level.card.needs:
            refusal = f"reads {' and '.join(level.card.needs)} entries, which only the environment can write"
        if refusal is not None:
            raise ConfigError(f"export: {type(level).__name__} cannot be exported: it {refusal}")
    if agent.specs.has_parameter_bounds or agent.specs.has_pair_mask:
        what = "bounds of the parameters in each state" if agent.specs.has_parameter_bounds else "a pair_mask"
        raise ConfigError(
            f"export: {_names(agent)} cannot be exported: the problem has {what}, which files cannot read"
        )
    exploring = {key for level in _levels(agent) if isinstance(level, Learner) for key in level.exploring_keys}
    exploring |= {key for each in agent.explorations if isinstance(each, Exploration) for key in each.exploring_keys}
    remembered = [key for key in agent.router.state_keys if key not in exploring]
    if remembered:
        raise ConfigError(f"export: {_names(agent)} cannot be exported: it remembers {remembered}")


def _traced(step: GreedyStep, about: Mapping[str, Any]) -> bytes:
    """Return the ONNX file of a step.

    Raises:
        ConfigError: the policy samples.
        RuntimeError: it cannot be traced.
    """
    import onnx_ir
    import onnx_ir.passes.common

    example = tuple(step.example().values())
    batch = {0: torch.export.Dim.DYNAMIC}
    program = torch.export.export(step, example, dynamic_shapes=((batch,) * len(example),), strict=False)
    for node in program.graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise ConfigError("export: the agent cannot be exported: it samples even if it acts greedily")
    num_outputs = 2 if step.selector is None else 3 if step.pairs is None else 4
    outputs = _OUTPUTS[:num_outputs]
    exported = torch.onnx.export(
        program,
        input_names=step.names,
        output_names=outputs,
        custom_translation_table={torch.ops.aten._cdist_forward.default: _distances},
        verbose=False,
    )
    assert exported is not None
    model = exported.model
    # Without the lines of code that torch notes at each node.
    onnx_ir.passes.common.ClearMetadataAndDocStringPass()(model)
    model.metadata_props.update({name: json.dumps(value) for name, value in about.items()})
    for value in (*model.graph.inputs, *model.graph.outputs):
        assert value.shape is not None
        value.shape = onnx_ir.Shape(["N", *value.shape[1:]])
    return onnx_ir.to_proto(model).SerializeToString()


def _distances(first: Any, second: Any, p: float, compute_mode: Any) -> Any:
    """Return `torch.cdist` of matrices, which torch cannot convert, as ONNX."""
    from onnxscript import opset18

    assert p == 2.0
    op: Any = opset18
    difference = op.Sub(op.Unsqueeze(first, [-2]), op.Unsqueeze(second, [-3]))
    return op.Sqrt(op.ReduceSumSquare(difference, [-1], keepdims=0))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress output, logs and warnings, such as those of torch and onnxscript, inside the block."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
