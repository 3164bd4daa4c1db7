"""Compare the numbers in the pages' sentences with the csv files of the studies.

python experiments/fill_numbers.py            prints a line for each number that differs
python experiments/fill_numbers.py --write    also puts the numbers of the csv files into the pages

In a page, comments enclose a number and say how it follows from rows. Other comments, at the end of the page, give
names to rows: a file and the values that columns have. GitHub and the site show neither.

    H-PPO scores <!--n mean(hppo.score):.3f-->3.334<!--/n--> with either controller.

    <!--data hppo: table1/results low=hppo boat=congruent|incongruent-->

- The file is a csv file under experiments/, of which the rows count that stand in tables (`standing_rows`). Or it is a
  JSON file of the repository with a row of its own, such as `agents/*/summary.json`.
- The expression is one of Python with columns, which are arrays, and `FUNCTIONS`. Also `hppo["eval/score"]`.
- The format is one of Python, or `word`, which writes 3 as three.
- No line may begin with such a comment: Markdown would end the paragraph there.
"""

from __future__ import annotations

import ast
import functools
import json
import operator
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.study_tables import Rows, standing_rows
from hpamdp.messages import exit_code

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("*.md", "agents/*.md", "docs/**/*.md", "experiments/*/README.md")
DATA = re.compile(r"^<!--data (\w+): (.+)-->$", re.MULTILINE)
NUMBER = re.compile(r"(<!--n (\S.*?):([^-\s]*)-->)(.*?)(<!--/n-->)")
WORDS = ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]


class Table:
    """Rows by their columns: `table.score`, or `table["eval/score"]`, is an array."""

    def __init__(self, rows: Rows) -> None:
        self._rows = rows

    def __getitem__(self, column: str) -> np.ndarray:
        return np.array([row[column] for row in self._rows])

    __getattr__ = __getitem__


class Several(list):
    """Numbers that a page shows side by side, and the words between them."""

    def __init__(self, numbers: Sequence[Any], between: str, before_last: str = "") -> None:
        super().__init__(numbers)
        self.between, self.before_last = between, before_last or between


def groups(values: np.ndarray, *keys: np.ndarray) -> Iterator[np.ndarray]:
    """Return the values by their keys, such as the scores of each learner, in order of appearance."""
    cells = [*zip(*keys, strict=True)]
    return (values[[cell == wanted for cell in cells]] for wanted in dict.fromkeys(cells))


FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("median", "sum", "round")},
    "mean": lambda *values: np.hstack(values).mean(),
    "min": lambda *values: np.hstack(values).min(),
    "max": lambda *values: np.hstack(values).max(),
    "count": lambda values: len(np.unique(values)),
    "means": lambda values, *keys: np.array([np.mean(group) for group in groups(values, *keys)]),
    # Of each run, in the first row in which something is true. A run without such a row is left out.
    "first": lambda values, is_there, run: np.array([group[0] for group in groups(values[is_there], run[is_there])]),
    # What follows is more than one number.
    "spread": lambda values: Several([np.mean(values), np.std(values, ddof=1)], " ± "),
    "span": lambda *values: Several([np.hstack(values).min(), np.hstack(values).max()], " to "),
    "each": lambda *values: Several(np.hstack(values), ", ", " and "),
}


OPERATORS: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.Invert: operator.invert,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def value_of(node: ast.AST, tables: Mapping[str, Table]) -> Any:
    """Return the value of an expression.

    Raises:
        SyntaxError: it has a part that is not among those at the head of this file.
    """
    of = functools.partial(value_of, tables=tables)
    match node:
        case ast.Constant(value):
            pass
        case ast.Name(name):
            value = tables[name]
        case ast.Attribute(table, column):
            value = of(table)[column]
        case ast.Subscript(values, place):
            value = of(values)[of(place)]
        case ast.Call(ast.Name(name), arguments, []):
            value = FUNCTIONS[name](*map(of, arguments))
        case ast.UnaryOp(sign, operand):
            value = OPERATORS[type(sign)](of(operand))
        case ast.BinOp(left, sign, right) | ast.Compare(left, [sign], [right]):
            value = OPERATORS[type(sign)](of(left), of(right))
        case _:
            raise SyntaxError(f"{ast.unparse(node)}: no such expression")
    return value


def text_of(value: Any, style: str) -> str:
    """Return a number, or several, as a page writes it."""
    if isinstance(value, Several):
        texts = [text_of(number, style) for number in value]
        if value.between == " to ":
            texts = [*dict.fromkeys(texts)]  # 4 to 4 is 4
        return value.before_last.join([*filter(None, [value.between.join(texts[:-1])]), texts[-1]])
    if style == "word":
        return WORDS[int(value)]
    return format(value, style).replace("-", "\u2212")


@functools.cache
def rows_of(path: str) -> Rows:
    if path.endswith(".json"):
        return [json.loads(file.read_text(encoding="utf-8")) for file in sorted(ROOT.glob(path))]
    return standing_rows(ROOT / f"experiments/{path}.csv")


def table(source: str) -> Table:
    """Return the rows of a file whose columns have the wanted values.

    Raises:
        LookupError: there is no such row.
    """
    path, *conditions = shlex.split(source)
    wanted = {column: values.split("|") for column, _, values in (each.partition("=") for each in conditions)}
    found = [
        row
        for row in rows_of(path)
        if all(str(row[column]).removesuffix(".0") in values for column, values in wanted.items())
    ]
    if not found:
        raise LookupError(f"no row has {source}")
    return Table(found)


def filled(page: str) -> str:
    """Return the text of a page with the numbers of the csv files."""
    tables = {name: table(source) for name, source in DATA.findall(page)}

    def number(found: re.Match[str]) -> str:
        value = value_of(ast.parse(found[2], mode="eval").body, tables)
        return found[1] + text_of(value, found[3]) + found[5]

    return NUMBER.sub(number, page)


def differences(root: Path = ROOT, write: bool = False) -> list[str]:
    """Return a line for each number that differs from the csv files, and for each page that cannot be filled in."""
    lines = []
    for page in (page for pattern in PAGES for page in sorted(root.glob(pattern))):
        name, old = page.relative_to(root).as_posix(), page.read_text(encoding="utf-8")
        try:
            new = filled(old)
        except Exception as error:  # one page must not hide the others
            lines.append(f"{name}: {type(error).__name__}: {error}")
            continue
        for said, is_now in zip(NUMBER.findall(old), NUMBER.findall(new), strict=True):
            if said != is_now:
                lines.append(f"{name}: says {said[3]}, {said[1]} is {is_now[3]}")
        if write and new != old:
            page.write_text(new, encoding="utf-8")
    return lines


def main(words: Sequence[str]) -> int:
    """Print the differences. Return 1 if there are any, else 0."""
    lines = differences(write="--write" in words)
    print(*lines, sep="\n")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
