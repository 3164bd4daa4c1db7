"""The public names of the package, with their modules."""

from .api.agent import Agent as Agent
from .api.judging import judge as judge
from .api.loading import load as load
from .api.making import make as make
from .api.making import make_gymnasium as make_gymnasium
from .api.reporting import report as report
from .api.training import train as train
from .api.tuning import tune as tune
from .config.errors import ConfigError as ConfigError
from .env.base import PAMDPEnv as PAMDPEnv
from .env.errors import EnvironmentFaultError as EnvironmentFaultError
from .policies.base import Learner as Learner
from .policies.base import Selector as Selector
from .policies.high_level.actor import Actor as Actor
from .policies.high_level.epsilon_greedy import EpsilonGreedy as EpsilonGreedy
from .policies.high_level.exp3 import Exp3 as Exp3
from .policies.high_level.lin_thompson import LinThompson as LinThompson
from .policies.high_level.linucb import LinUCB as LinUCB
from .policies.high_level.meta_critic import MetaCritic as MetaCritic
from .policies.high_level.option_critic import OptionCritic as OptionCritic
from .policies.high_level.thompson import Thompson as Thompson
from .policies.high_level.ucb import UCB as UCB
from .policies.low_level.bc import BC as BC
from .policies.low_level.dlpa.learner import DLPA as DLPA
from .policies.low_level.hppo import HPPO as HPPO
from .policies.low_level.hsac import HSAC as HSAC
from .policies.low_level.hyar import HyAR as HyAR
from .policies.low_level.iql import IQL as IQL
from .policies.low_level.paddpg import PADDPG as PADDPG
from .policies.low_level.pdqn import PDQN as PDQN
from .policies.low_level.pets.learner import PETS as PETS
from .policies.low_level.qpamdp import QPAMDP as QPAMDP
from .policies.low_level.td3_bc import TD3BC as TD3BC
from .run.callbacks import BestAgent as BestAgent
from .run.callbacks import Callback as Callback
from .run.callbacks import OwnMetrics as OwnMetrics
from .run.callbacks import Patience as Patience
from .run.callbacks import TimeLimit as TimeLimit
from .run.trainer import DivergedError as DivergedError
from .specs import PAMDPSpecs as PAMDPSpecs

__version__: str
