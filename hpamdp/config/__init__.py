"""Settings of a run: `compose` reads them, `schema` and `components` check them, `errors` words the mistakes."""
