"""What a mechanism can do and where it fails: singularities, curves of them, maps, certificates of controllers."""
