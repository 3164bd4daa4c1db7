"""A research framework for hierarchical and parameterised-action reinforcement learning.

Importing it registers the Gymnasium ids of its problems and loads neither torch nor TorchRL.
"""

from hpamdp.env.registration import register

__version__ = "0.2.0"

register()
