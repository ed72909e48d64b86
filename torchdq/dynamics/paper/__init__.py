"""The reference form: the algorithms of the paper, in dual quaternions and any link frames."""
