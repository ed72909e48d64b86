"""General form: the algorithms of the paper in dual quaternions, in any link frames."""
