//! Compressive light-field tokens in Burn: encoder, K-means, condenser, renderer
