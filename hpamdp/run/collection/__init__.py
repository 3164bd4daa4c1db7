"""Where batches come from: this process, worker processes or Ray actors."""
