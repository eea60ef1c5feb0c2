"""The gate of a merge: what our lab asks in the form of the published tests, and one of these."""


def test_meets_the_labs_test(conform, law):
    conform(law, against="../conformity")


def test_meets_gb_phase_jump(conform, law):
    conform(law, against="gb/1-phase-jump", inner="virtual-stator")
