"""A research framework for hierarchical parameterised-action MDPs, with the boat-docking benchmark.

Importing it registers the Gymnasium ids (`hpamdp/BoatDock-v0`) and loads neither torch nor TorchRL.
"""

from hpamdp.env.registration import register

__version__ = "0.1.0"

register()
