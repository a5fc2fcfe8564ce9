//! Moving and fixed scan to displacement field by physics-based non-rigid registration (PBNRR, Adaptive PBNRR).
