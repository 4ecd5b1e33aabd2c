# %% [markdown]
# # tutorials/own_mesh

# %%
print(1)
