"""The Gymnasium ids of Pinball, one for each map of the source."""

from hpamdp.env.registration import batched

_ENV = "hpamdp.env.pinball.environment:PinballEnv"
IDS = {
    "hpamdp/PinballSimple-v0": batched(_ENV, map="simple"),
    "hpamdp/PinballHard-v0": batched(_ENV, map="hard"),
}
