from hypothesis import settings

# Wall-clock deadlines judge the machine, not the code.
settings.register_profile("proto", deadline=None, max_examples=40)
settings.load_profile("proto")
