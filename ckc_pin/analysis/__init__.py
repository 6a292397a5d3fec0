"""What a mechanism can do and where it fails: singularities, maps; what each setting of a run costs."""
