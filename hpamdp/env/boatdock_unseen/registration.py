"""The Gymnasium ids of unknown boats, one for each family."""

from hpamdp.env.registration import batched

_ENV = "hpamdp.env.boatdock_unseen.environment:UnseenBoatsEnv"
IDS = {
    "hpamdp/BoatDockUnseen-v0": batched(_ENV, family="turned"),
    "hpamdp/BoatDockUnseenAny-v0": batched(_ENV, family="any"),
    "hpamdp/BoatDockUnseenStrength-v0": batched(_ENV, family="strength"),
}
