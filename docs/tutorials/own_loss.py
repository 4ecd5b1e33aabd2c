# %% [markdown]
# # tutorials/own_loss

# %%
print(1)
