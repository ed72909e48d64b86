"""Parameters of a simulated scene from recorded motions, by multiple shooting."""
