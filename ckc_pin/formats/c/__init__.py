"""Write a mechanism's dynamics and the paper's controllers as C99 without dependencies, for the computer of a robot."""
