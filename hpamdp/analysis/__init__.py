"""Tables and statistics of studies, and figures that suit every problem."""
