"""Tables and statistics of studies, and figures that know no problem."""
