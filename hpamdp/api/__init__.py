"""The functions behind `import hpamdp`: thin, over `hpamdp.run`."""
