"""Problems, and what serves any of them."""
