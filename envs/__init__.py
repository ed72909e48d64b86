"""Scenes and gymnasium environments of torchdq; imported as `torchdq.envs`, never as `envs`."""
