"""Refractive indices, Fresnel, thin films, effective media."""
