"""Import the classes of this package in a fraction of a second, with stand-ins for libraries that take seconds.

A wrong setting can be refused from the settings models and class attributes alone. But the files that define them also
import torch. Inside `quick_imports`, stand-ins replace torch and other slow libraries. The files can then be imported,
but their code cannot run. After the block, all modules with stand-ins are gone.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

_SLOW = frozenset(
    {
        "gymnasium",
        "h5py",
        "matplotlib",
        "minari",
        "numba",
        "numpy",
        "optuna",
        "PIL",
        "pooch",
        "ray",
        "scipy",
        "tensorboard",
        "tensordict",
        "torch",
        "torchrl",
        "tqdm",
        "wandb",
    }
)
_PACKAGE = __name__.partition(".")[0]
# Modules of this package that were imported with stand-ins, and the stand-ins themselves.
_modules: dict[str, ModuleType] = {}


class RealImportsNeededError(Exception):
    """Raised if a class of another package is needed where stand-ins replace the slow libraries."""


def works_with_stand_ins(dotted: str) -> bool:
    """Return whether a class may be imported with stand-ins: only this package is written for them."""
    return dotted.partition(".")[0] == _PACKAGE


def check_works_with_stand_ins(dotted: str) -> None:
    """Refuse to import another package's class with stand-ins.

    Raises:
        RealImportsNeededError: the class needs the real libraries.
    """
    if not works_with_stand_ins(dotted) and any(isinstance(finder, _Finder) for finder in sys.meta_path):
        raise RealImportsNeededError(dotted)


@contextmanager
def quick_imports() -> Iterator[None]:
    """Import modules of this package with stand-ins for slow libraries, unless torch has been imported already."""
    if "torch" in sys.modules:
        yield
        return
    before = set(sys.modules)
    finder = _Finder()
    sys.modules.update(_modules)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            if name.partition(".")[0] in _SLOW | {_PACKAGE}:
                _modules[name] = sys.modules.pop(name)
                parent, _, child = name.rpartition(".")
                if parent in before:  # otherwise `from parent import child` would find the module there
                    vars(sys.modules[parent]).pop(child, None)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds a stand-in for every slow library and for every module of it."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname.partition(".")[0] not in _SLOW:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


class _Module(ModuleType):
    """A module in which every name is a class to derive from, to call and to calculate with."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = _stand_in(name)
        setattr(self, name, value)
        return value


class _Anything(type):
    """The class of stand-ins. Every operation on one returns another. A class derived from one is an ordinary class."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__") or not _is_stand_in(cls):
            raise AttributeError(f"type object {cls.__name__!r} has no attribute {name!r}")
        return _stand_in(name)

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        if not _is_stand_in(cls):
            return super().__call__(*args, **kwargs)
        # As a decorator it leaves the function or class as it is.
        is_decorator = len(args) == 1 and not kwargs and callable(args[0]) and not _is_stand_in(args[0])
        return args[0] if is_decorator else _stand_in(cls.__name__)

    def __getitem__(cls, key: Any) -> Any:
        return cls

    def __iter__(cls) -> Iterator[Any]:
        return iter(())

    def __int__(cls) -> int:
        return 0

    __index__ = __int__

    def __float__(cls) -> float:
        return 0.0

    def _calculate(cls, *others: Any) -> Any:
        return cls

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = _calculate
    __floordiv__ = __mod__ = __pow__ = __rpow__ = __matmul__ = __neg__ = __invert__ = _calculate
    __and__ = __rand__ = __or__ = __ror__ = __xor__ = __lshift__ = __rshift__ = _calculate
    __lt__ = __le__ = __gt__ = __ge__ = _calculate


def _stand_in(name: str) -> Any:
    return _Anything(name, (), {"is_stand_in": True})


def _is_stand_in(value: object) -> bool:
    return isinstance(value, _Anything) and "is_stand_in" in vars(value)
