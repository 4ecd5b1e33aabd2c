# %% [markdown]
# # tutorials/own_arrays

# %%
print(1)
