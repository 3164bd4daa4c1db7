"""The Robot Soccer Goal domain and Hard Goal."""
