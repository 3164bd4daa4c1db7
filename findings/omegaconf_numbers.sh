#!/usr/bin/env bash
# OmegaConf 2.3.1 with Hydra 1.3.8: a value in a file and the same value on the command line are read differently.
#
# Guess: Hydra's overrides follow the rules of its YAML files.
# Behaviour: two grammars meet. `nan`, `inf` and `-inf` are numbers on the command line and text in a file, and `.inf` is
# the other way round. `010`, `0x10`, `1:30`, `on` and `no` are text on the command line. In a file they are 8, 16, 90,
# True and False. Fields with a declared type hide some of it, keyword arguments of an environment do not.
# Seen: all of the above. The script fails if this changes.
# Why it matters: an environment that takes `max_speed=inf` in the shell gets the text "inf" from a file, and a list of
# names such as [on, no] or start times such as 1:30 changes its type on the way into one.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check hydra-core==1.3.8 omegaconf==2.3.1
"$folder/venv/bin/python" - <<'PYTHON'
import sys

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

expected = {
    "nan": ("float", "str"),
    "inf": ("float", "str"),
    "-inf": ("float", "str"),
    ".inf": ("str", "float"),
    "010": ("str", "int"),
    "0x10": ("str", "int"),
    "1:30": ("str", "int"),
    "on": ("str", "bool"),
    "no": ("str", "bool"),
    "1e-3": ("float", "float"),
    "1_000": ("int", "int"),
}
parser = OverridesParser.create()
seen = {}
for text in expected:
    in_shell = parser.parse_override(f"value={text}").value()
    in_shell = str(in_shell) if type(in_shell).__name__ == "QuotedString" else in_shell
    in_file = OmegaConf.create(f"value: {text}").value
    print(f"{text:>6}  shell {in_shell!r:>8}  file {in_file!r}")
    seen[text] = (type(in_shell).__name__, type(in_file).__name__)
sys.exit(seen != expected)
PYTHON
