"""Many runs of one scene with other parameters."""
