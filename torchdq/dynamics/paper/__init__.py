"""The reference form: the algorithms as the paper has them, in dual quaternions and link frames of any choice."""
