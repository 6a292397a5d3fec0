"""What a mechanism can do and where it fails: singularities, maps, certificates; what each setting of a run costs."""
