"""Questions over many runs: the paper's claims, each answered with numbers."""
