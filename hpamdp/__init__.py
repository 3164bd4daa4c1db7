"""A research framework for hierarchical and parameterised-action reinforcement learning.

Importing it registers the Gymnasium ids of its problems and loads neither torch nor TorchRL.
"""

from hpamdp.search_path import is_command_line, put_working_directory_last

__version__ = "0.3.0"

if is_command_line():
    # `python -m` puts the working directory first, and the next import needs other packages.
    put_working_directory_last()
else:
    # The command line leaves this to `env=gymnasium`: importing Gymnasium takes longer than refusing a wrong setting.
    from hpamdp.env.registration import register

    register()
