"""Code generation: the terms of one mechanism as CasADi expressions and as a compiled C library.

`library.compile_terms` writes, compiles, checks and caches a library; `library.find_compiled_terms` only looks into the
cache. CasADi is imported only to write code: a cached library is loaded without it.
"""
