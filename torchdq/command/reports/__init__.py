"""Reports of the command line: overview of a robot, speed, health of an installation."""
