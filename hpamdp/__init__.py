"""A research framework for hierarchical and parameterised-action reinforcement learning.

Importing it registers the Gymnasium ids of its problems and loads neither torch nor TorchRL.
"""

from hpamdp.search_path import is_command_line, put_working_directory_last

# `python -m` puts the working directory first, and the next import needs other packages.
if is_command_line():
    put_working_directory_last()

from hpamdp.env.registration import register

__version__ = "0.2.0"

register()
