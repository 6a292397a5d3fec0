"""Read MuJoCo models (MJCF) with MuJoCo's compiler, and write them."""
