"""Further commands of `hpamdp`, each with flags of its own: watch, play and judge."""
