"""The terms written out for one mechanism: `compiled` makes and keeps them, `find` takes what was kept.

CasADi is imported only where terms are written out; what was compiled is loaded without it.
"""
