# %% [markdown]
# # tutorials/mstar_chips

# %%
print(1)
